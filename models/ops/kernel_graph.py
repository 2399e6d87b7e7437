"""Scatter and collect (`models.ops.kernel_blocks`) as short graphs, for traced and exported modules.

Convolutions with unit vectors shift K maps at a time, columns first and rows second: a few nodes whatever K
and the sizes of the image. They hold all weights and one product with them, which a runtime can afford and a
training step cannot.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_FAR = 1e4
"""Shift beyond the border, where exp of what remains is 0 in float32 and float64 sums alike."""


def weights(
    numbers: Tensor, size: int, source: Tensor | None, target: Tensor | None, beyond: bool = False
) -> Tensor:
    """Return numbers, or their exponentials after a shift, (B, N, K * K, H, W); see `Kernels`.

    With `beyond` the shift of the pixels that are reached has H + K - 1 rows.
    """
    if source is not None:
        numbers = numbers - source
    if target is not None:
        numbers = numbers - _neighbours(target, size, _FAR, beyond)[:, None]
    return numbers if source is None and target is None else torch.exp(numbers)


def scatter(values: Tensor, kernels: Tensor, size: int, beyond: bool = False) -> Tensor:
    """Return totals and weights (B, C + 1, H, W) of values (B, N, C, H, W), kernels (B, N, K * K, H, W).

    With `beyond` they have H + K - 1 rows.
    """
    sums = [
        _added((kernels * value).sum(1), size, beyond)
        for value in (*values.split(1, 2), torch.ones_like(values[:, :, :1]))
    ]
    return torch.cat(sums, 1)


def collect(image: Tensor, kernels: Tensor, size: int) -> Tensor:
    """Return the sums (B, N, C, H, W) of images (B, N, C, H, W)."""
    flat, owned = image.flatten(0, 1), kernels.flatten(0, 1)
    parts = [(owned * _neighbours(channel, size)).sum(1, keepdim=True) for channel in flat.split(1, 1)]
    return torch.cat(parts, 1).reshape(image.shape)


def arriving_maximum(numbers: Tensor, size: int, outside: float, beyond: bool = False) -> Tensor:
    """Return the largest number that reaches each pixel, (B, 1, H, W), with `beyond` H + K - 1 rows.

    Numbers (B, N, K * K, H, W) from outside the image count as given.
    """
    return _arrived(numbers.amax(1), size, outside, beyond).amax(1, keepdim=True)


def inside_maximum(numbers: Tensor, size: int) -> Tensor:
    """Return the largest number (B, 1, H, W) of each pixel's kernel (B, K * K, H, W) that stays inside."""
    beyond = 1 - _neighbours(torch.ones_like(numbers[:1, :1]), size)
    return (numbers - _FAR * beyond).amax(1, keepdim=True)


def outside_count(image: Tensor, size: int) -> Tensor:
    """Return how many of each pixel's K * K neighbours lie outside an image (B, 1, H, W)."""
    return (1 - _neighbours(torch.ones_like(image), size)).sum(1, keepdim=True)


def _units(size: int, like: Tensor, flipped: bool) -> Tensor:
    eye = torch.eye(size).flip(0) if flipped else torch.eye(size)
    return eye.to(like)


def _neighbours(image: Tensor, size: int, outside: float = 0.0, beyond: bool = False) -> Tensor:
    """Return the image (B, 1, H, W) shifted by every offset, (B, K * K, H, W): map q holds image(p + q).

    With `beyond` the image has the rows around it, H + K - 1.
    """
    units, reach = _units(size, image, False), size // 2
    with torch.autocast(image.device.type, enabled=False):
        padded = F.pad(image, [reach, reach] if beyond else [reach] * 4, value=outside)
        below = F.conv2d(padded, units.reshape(size, 1, size, 1))
        # Output channel dy * K + dx of a group dy.
        return F.conv2d(below, units.reshape(size, 1, 1, size).repeat(size, 1, 1, 1), groups=size)


def _arrived(maps: Tensor, size: int, outside: float, beyond: bool) -> Tensor:
    """Return maps (B, K * K, H, W) at the pixels they go to: map q holds maps_q(p - q)."""
    units, reach = _units(size, maps, True), size // 2
    with torch.autocast(maps.device.type, enabled=False):
        around = 2 * reach if beyond else reach
        padded = F.pad(maps, [reach, reach, around, around], value=outside)
        rows = units.reshape(size, 1, 1, size, 1).expand(size, size, 1, size, 1).reshape(-1, 1, size, 1)
        columns = units.reshape(1, size, 1, 1, size).expand(size, size, 1, 1, size).reshape(-1, 1, 1, size)
        return F.conv2d(F.conv2d(padded, rows, groups=size * size), columns, groups=size * size)


def _added(maps: Tensor, size: int, beyond: bool) -> Tensor:
    """Return the sum over q of maps_q(p - q), (B, 1, H, W), of maps (B, K * K, H, W)."""
    units, reach = _units(size, maps, True), size // 2
    with torch.autocast(maps.device.type, enabled=False):
        columns = units.reshape(1, size, 1, size).repeat(size, 1, 1, 1)
        across = F.conv2d(maps, columns, padding=(0, reach), groups=size)
        return F.conv2d(across, units.reshape(1, size, size, 1), padding=(2 * reach if beyond else reach, 0))
