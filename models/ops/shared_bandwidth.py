"""The bandwidth at which estimated squared bias and variance of a local fit are least together."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

_TINY = 1e-200
"""Keeps divisions by 0 finite."""


def shared_bandwidth(
    trials: Sequence[float], bias: Tensor, variance: Tensor, rank: Tensor, least: float = 0.01
) -> Tensor:
    """Return the bandwidth of least mean squared error, (P,) in [least, 1].

    Args:
        trials: Bandwidths that were tried, T of them.
        bias: Result of each minus the noisy value, (T, P).
        variance: Of each result, (T, P).
        rank: Dimensions of the fit, (P,).
        least: Returned where the variance does not fall with the bandwidth.
    """
    h = torch.cat([torch.full_like(bias[:1, :1], trial) for trial in trials])
    of_bias, of_variance = _slope(h.square(), bias), _slope(h.pow(-rank), variance)
    quotient = rank * of_variance / (4 * of_bias.square()).clamp_min(_TINY)
    power = rank + 4
    low = torch.full_like(quotient, least).pow(power)
    inside = torch.minimum(torch.maximum(quotient, low), torch.ones_like(quotient))
    return torch.where(of_variance > 0, inside, low).pow(1 / power)


def _slope(x: Tensor, y: Tensor) -> Tensor:
    """Return the slope of the line that fits y (T, P) over x: exactly 0 where all y are the same."""
    centred = x - x.mean(0)
    return (centred * (y - y[:1])).sum(0) / centred.square().sum(0)


def smoothed(image: Tensor, sigma: float, reach: int) -> Tensor:
    """Smooth (B, 1, H, W) by a Gaussian cut off at `reach`, of which what is inside the image counts."""
    if not reach:
        return image
    steps = torch.arange(-reach, reach + 1, device=image.device, dtype=image.dtype)
    along = torch.exp(-0.5 * (steps / sigma).square())
    kernel = (along[:, None] * along)[None, None]
    total = F.conv2d(image, kernel, padding=reach)
    return total / F.conv2d(torch.ones_like(image), kernel, padding=reach)
