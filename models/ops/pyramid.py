"""Image pyramid by factors of 2: Gaussian low pass down, bicubic up.

The Gaussian has sigma 0.55 sqrt(1 / s^2 - 1) = 0.953 for s = 1/2 and is cut where it falls below 1e-2 of its
centre (Delbracio et al. 2014, `models.classical.nlm.MultiScaleNLM`). A coarse pixel lies in the middle of its
four fine ones, so taps are 0.5, 1.5 and 2.5 pixels away. Borders repeat the last pixel.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

_SIGMA = 0.55 * math.sqrt(3.0)
_RAW = [math.exp(-((x + 0.5) ** 2) / (2 * _SIGMA**2)) for x in (-3, -2, -1, 0, 1, 2)]
LOW_PASS = tuple(value / sum(_RAW) for value in _RAW)
"""Taps of the low pass along one axis."""


def coarser(image: Tensor) -> Tensor:
    """Return (B, C, H / 2, W / 2) of (B, C, H, W) with even H and W."""
    return _down(image, list(LOW_PASS))


def coarser_variance(variance: Tensor) -> Tensor:
    """Return the variance of what `coarser` makes of an image with independent pixels of this variance."""
    return _down(variance, [w * w for w in LOW_PASS])


def finer(image: Tensor) -> Tensor:
    """Return (B, C, 2 H, 2 W), bicubic."""
    return F.interpolate(image, scale_factor=2, mode="bicubic", align_corners=False)


def merged(fine: Tensor, coarse: Tensor) -> Tensor:
    """Return a filtered image whose low frequencies are those of the filtered coarser one."""
    return fine + finer(coarse - coarser(fine))


def reach(filter_reach: int, scales: int) -> int:
    """Return how far a core of 2^(scales - 1) pixels looks: its filter, or through the coarser scales."""
    if scales == 1:
        return filter_reach
    side = len(LOW_PASS) // 2 - 1  # down-sampling adds this, up-sampling two coarse pixels
    through = 2 * (max(reach(filter_reach, scales - 1), 0) + 2) + side
    return max(filter_reach + 4 + side, through)


def _down(image: Tensor, taps: list[float]) -> Tensor:
    margin = len(taps) // 2 - 1
    result = F.pad(image, [margin] * 4, mode="replicate")
    for axis in (-2, -1):
        # Ends are counted from the far side: a traced graph takes any size.
        steps = (slice(i, i + 1 - len(taps) or None, 2) for i in range(len(taps)))
        others = (slice(None),) * (-1 - axis)
        parts = [tap * result[(..., step, *others)] for tap, step in zip(taps, steps, strict=True)]
        result = torch.stack(parts).sum(0)
    return result
