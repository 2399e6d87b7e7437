"""Temporal antialiasing of finished images, as BMFR does it.

The preceding output is fetched where the pixel was, whatever surface it showed there, and clamped to what
the pixel's neighbours now allow, in YCoCg,

    out = a new + (1 - a) min(max(old, low), high),   a = 0.2

with low and high the means of the bounds of the 3x3 pixels around and of the cross of five pixels. What came
from outside the image stays new.

Source: Koskela et al. 2019, doi:10.1145/3269978, after Karis, "High Quality Temporal Supersampling", SIGGRAPH
2014 courses. It works on display values, radiance to the power of 0.454545. There these are cut at 1 before;
here brightness above stays, unless the caller cuts it, since the result is to be linear radiance.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.precision import wide
from models.ops.reproject import Neighbours
from models.ops.tonemap import GAMMA

NEW = 0.2
"""Weight of the new image."""

_DARKEST = 1e-12
"""Below this the curve is a line, so that its slope stays finite."""


def antialiased(image: Tensor, last: Tensor, neighbours: Neighbours, new: float = NEW) -> Tensor:
    """Return the image (B, 3, H, W) blended with the preceding one; linear radiance throughout.

    Args:
        image: At least 0.
        last: The preceding result, in the same units.
        neighbours: Where pixels were, from `models.ops.reproject.bilinear`, without tests of surfaces.
        new: Weight of the new image, in (0, 1].
    """
    now, before = ycocg(display(image)), ycocg(neighbours.mean(display(last)))
    low, high = bounds(now)
    blended = new * now + (1 - new) * torch.minimum(torch.maximum(before, low), high)
    seen = neighbours.total > 0
    return torch.where(seen, linear(rgb(blended).clamp_min(0.0)), wide(image))


def bounds(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return low and high (B, C, H, W); pixels outside the image take no part."""
    around = F.pad(image, [1] * 4, mode="replicate")  # repeated pixels change no extremum
    low, high = (_extremum(around, choose) for choose in (torch.minimum, torch.maximum))
    return low, high


def _extremum(around: Tensor, choose: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Return the mean of the extremum of 3x3 pixels and of a cross; by rows and columns, not by pooling."""
    column = choose(choose(around[..., :-2, :], around[..., 1:-1, :]), around[..., 2:, :])
    middle = column[..., 1:-1]
    square = choose(choose(column[..., :-2], middle), column[..., 2:])
    cross = choose(choose(around[..., 1:-1, :-2], middle), around[..., 1:-1, 2:])
    return 0.5 * (square + cross)


def display(radiance: Tensor) -> Tensor:
    """Return max(x, 0) ** 0.454545, in float32 or wider; a line below 1e-12."""
    positive = wide(radiance).clamp_min(0.0)
    curve = positive.clamp_min(_DARKEST).pow(GAMMA)
    return torch.where(positive < _DARKEST, positive * _DARKEST ** (GAMMA - 1.0), curve)


def linear(value: Tensor) -> Tensor:
    """Return the radiance of display values, which are at least 0: the inverse of `display`."""
    curve = value.pow(1.0 / GAMMA)
    return torch.where(value < _DARKEST**GAMMA, value * _DARKEST ** (1.0 - GAMMA), curve)


def ycocg(color: Tensor) -> Tensor:
    """Return luma and two chroma channels, (B, 3, H, W)."""
    red, green, blue = color.unbind(1)
    return torch.stack([(red + 2 * green + blue) / 4, (red - blue) / 2, (2 * green - red - blue) / 4], 1)


def rgb(color: Tensor) -> Tensor:
    """Return red, green and blue of `ycocg`."""
    luma, orange, lime = color.unbind(1)
    return torch.stack([luma + orange - lime, luma + lime, luma - orange - lime], 1)
