"""Structural similarity (Wang et al. 2004, equations 6 to 13) of display values, for every definition in use.

Only windows inside the image count; the mean is over windows and channels. Windows are separable, so sums
along rows are taken before those along columns, and an image is worked on in strips that fit into the caches
of a processor: the same sums in a fraction of the time and memory of whole images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

STRIP = 16
"""Rows of windows that are worked on at a time."""


def uniform_similarity(x: Tensor, y: Tensor, data_ranges: Sequence[float], size: int = 7) -> list[Tensor]:
    """Return the mean similarity per image (B,) under a uniform window, with sample covariance.

    Args:
        x: Display values (B, C, H, W), float64.
        y: What they should be.
        data_ranges: Largest difference of two display values; one result for each.
        size: Side of the window.

    Raises:
        ValueError: The image is smaller than the window.
    """
    unbiased = size * size / (size * size - 1)
    totals = [torch.zeros(len(x), dtype=torch.float64, device=x.device) for _ in data_ranges]
    for mx, my, vx, vy, vxy in _moments(x, y, [1 / size] * size):
        for total, data_range in zip(totals, data_ranges, strict=True):
            luminance, structure = _parts(mx, my, unbiased * vx, unbiased * vy, unbiased * vxy, data_range)
            total += (luminance * structure).flatten(1).sum(1)
    return [(total / _windows(x, size)).float() for total in totals]


def gaussian_similarity(x: Tensor, y: Tensor, size: int, sigma: float, data_range: float) -> Tensor:
    """Return the mean similarity per image (B,) under a Gaussian window, with biased variances.

    Arguments and errors as `uniform_similarity`, and `sigma`, the window's standard deviation in pixels.
    """
    return gaussian_means(x, y, size, sigma, data_range)[0].float()


def gaussian_means(x: Tensor, y: Tensor, size: int, sigma: float, data_range: float) -> tuple[Tensor, Tensor]:
    """Return the means (B,), float64, of similarity and of its contrast-structure part alone.

    Arguments and errors as `gaussian_similarity`.
    """
    offsets = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    weights = torch.exp(-torch.square(offsets) / (2 * sigma * sigma))
    whole, part = torch.zeros(2, len(x), dtype=torch.float64, device=x.device)
    for mx, my, vx, vy, vxy in _moments(x, y, (weights / weights.sum()).tolist()):
        luminance, structure = _parts(mx, my, vx, vy, vxy, data_range)
        part += structure.flatten(1).sum(1)
        whole += (luminance * structure).flatten(1).sum(1)
    return whole / _windows(x, size), part / _windows(x, size)


def _moments(x: Tensor, y: Tensor, weights: list[float]) -> Iterator[tuple[Tensor, ...]]:
    """Yield means of x and y, their variances and covariance under a separable window, strip by strip.

    Raises:
        ValueError: The image is smaller than the window.
    """
    size = len(weights)
    if min(x.shape[-2:]) < size:
        raise ValueError(f"SSIM needs at least {size}x{size} pixels, got {tuple(x.shape[-2:])}")
    rows = x.shape[-2] - size + 1
    for first in range(0, rows, STRIP):
        count = min(STRIP, rows - first) + size - 1
        one, other = x.narrow(-2, first, count), y.narrow(-2, first, count)
        maps = torch.stack([one, other, one * one, other * other, one * other])
        mx, my, mxx, myy, mxy = _weighted(_weighted(maps, weights, -1), weights, -2)
        yield mx, my, mxx - mx * mx, myy - my * my, mxy - mx * my


def _weighted(maps: Tensor, weights: list[float], axis: int) -> Tensor:
    """Return weighted sums of successive rows or columns; no convolution, which autocast would round."""
    length = maps.shape[axis] - len(weights) + 1
    total = maps.narrow(axis, 0, length) * weights[0]
    for place, weight in enumerate(weights[1:], 1):
        total.add_(maps.narrow(axis, place, length), alpha=weight)
    return total


def _windows(image: Tensor, size: int) -> int:
    """Return the number of windows of an image in all its channels."""
    channels, height, width = image.shape[1:]
    return channels * (height - size + 1) * (width - size + 1)


def _parts(
    mx: Tensor, my: Tensor, vx: Tensor, vy: Tensor, vxy: Tensor, data_range: float
) -> tuple[Tensor, Tensor]:
    """Return both factors of the similarity from windows' means, variances and covariance."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    return (2 * mx * my + c1) / (mx * mx + my * my + c1), (2 * vxy + c2) / (vx + vy + c2)
