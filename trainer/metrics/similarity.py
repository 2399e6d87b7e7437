"""Structural similarity (Wang et al. 2004, equations 6 to 13) of display values, for every definition in use.

Only windows inside the image count; the mean is over windows and channels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def uniform_similarity(x: Tensor, y: Tensor, data_range: float, size: int = 7) -> Tensor:
    """Return the mean similarity per image (B,) under a uniform window, with sample covariance.

    Args:
        x: Display values (B, C, H, W), float64.
        y: What they should be.
        data_range: Largest difference of two display values.
        size: Side of the window.

    Raises:
        ValueError: The image is smaller than the window.
    """
    _check_window(x, size)
    unbiased = size * size / (size * size - 1)

    def mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, size, stride=1)

    mx, my = mean(x), mean(y)
    vx = unbiased * (mean(x * x) - mx * mx)
    vy = unbiased * (mean(y * y) - my * my)
    vxy = unbiased * (mean(x * y) - mx * my)
    return _similarity(mx, my, vx, vy, vxy, data_range)


def gaussian_similarity(x: Tensor, y: Tensor, size: int, sigma: float, data_range: float) -> Tensor:
    """Return the mean similarity per image (B,) under a Gaussian window, with biased variances.

    Arguments and errors as `uniform_similarity`, and `sigma`, the window's standard deviation in pixels.
    """
    luminance, structure = gaussian_parts(x, y, size, sigma, data_range)
    return (luminance * structure).flatten(1).mean(1).float()


def gaussian_parts(x: Tensor, y: Tensor, size: int, sigma: float, data_range: float) -> tuple[Tensor, Tensor]:
    """Return luminance and contrast-structure of every window inside the image; as `gaussian_similarity`."""
    _check_window(x, size)
    offsets = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    weights = torch.exp(-torch.square(offsets) / (2 * sigma * sigma))
    weights = weights / weights.sum()
    maps = torch.stack([x, y, x * x, y * y, x * y])
    mx, my, mxx, myy, mxy = _weighted(_weighted(maps, weights.tolist(), -1), weights.tolist(), -2)
    return _parts(mx, my, mxx - mx * mx, myy - my * my, mxy - mx * my, data_range)


def _weighted(maps: Tensor, weights: list[float], axis: int) -> Tensor:
    """Return weighted sums of successive rows or columns; no convolution, which autocast would round."""
    length = maps.shape[axis] - len(weights) + 1
    total = maps.narrow(axis, 0, length) * weights[0]
    for place, weight in enumerate(weights[1:], 1):
        total.add_(maps.narrow(axis, place, length), alpha=weight)
    return total


def _check_window(image: Tensor, size: int) -> None:
    if min(image.shape[-2:]) < size:
        raise ValueError(f"SSIM needs at least {size}x{size} pixels, got {tuple(image.shape[-2:])}")


def _parts(
    mx: Tensor, my: Tensor, vx: Tensor, vy: Tensor, vxy: Tensor, data_range: float
) -> tuple[Tensor, Tensor]:
    """Return both factors of the similarity from windows' means, variances and covariance."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    return (2 * mx * my + c1) / (mx * mx + my * my + c1), (2 * vxy + c2) / (vx + vy + c2)


def _similarity(mx: Tensor, my: Tensor, vx: Tensor, vy: Tensor, vxy: Tensor, data_range: float) -> Tensor:
    """Return the mean similarity per image from windows' means, variances and covariance."""
    luminance, structure = _parts(mx, my, vx, vy, vxy, data_range)
    return (luminance * structure).flatten(1).mean(1).float()
