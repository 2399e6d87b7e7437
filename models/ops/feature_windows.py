"""Windows of features and colours around pixels, cut out whole for a block of pixels at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import box_sum, exporting


class Noisy(NamedTuple):
    """Images and the variance of their pixels.

    Attributes:
        image: (B, C, H, W).
        variance: (B, C, H, W).
    """

    image: Tensor
    variance: Tensor


class Windows(NamedTuple):
    """The windows of P pixels with N neighbours each, in float64.

    Attributes:
        relative: Position (right, down) and features relative to the pixel, (P, D, N).
        groups: Number of channels that are scaled together, position first and each by itself.
        color: (P, 3, N), 0 where not inside.
        variance: Of the colour, mean of the channels, (P, 1, N).
        inside: 1 for neighbours in the image that are finite, (P, 1, N).
        noise: Sum of the features' variances over the window, (P, number of features).
        own: The pixel's own colour (P, 3), or the mean of its window where it is not finite.
        known: Whether it is finite, (P, 1).
        shape: Images, rows and columns of the block of pixels.
    """

    relative: Tensor
    groups: tuple[int, ...]
    color: Tensor
    variance: Tensor
    inside: Tensor
    noise: Tensor
    own: Tensor
    known: Tensor
    shape: tuple[int, int, int]

    def maps(self, numbers: Tensor) -> Tensor:
        """Return what was found for each pixel (P, …) as (B, rows, columns, …)."""
        return numbers.unflatten(0, self.shape)


class Stack:
    """All that windows are cut from, padded and in float64.

    Args:
        color: Radiance and the variance of its mean.
        features: Each is scaled as one vector.
        window: Radius of the windows.
    """

    def __init__(self, color: Noisy, features: Sequence[Noisy], window: int) -> None:
        self.window, self.device = window, color.image.device
        channels = [f.image.shape[1] for f in features]
        self.groups = (1, 1, *channels)
        self.dimensions = sum(self.groups)
        joined = torch.cat([*(f.image for f in features), *color], 1).double()
        known = joined.isfinite().all(1, keepdim=True)
        image = torch.where(joined.isfinite(), joined, 0.0)
        count = sum(channels)
        variance = image[:, count + 3 :].clamp_min(0.0).mean(1, keepdim=True) * known
        shown = image[:, count : count + 3] * known
        self.padded = F.pad(torch.cat([image[:, :count], shown, variance, known], 1), [window] * 4)
        self.size = (image.shape[0], image.shape[-2], image.shape[-1])
        sums = [(f.variance.double().sum(1, keepdim=True) * known) for f in features]
        joined_sums = torch.cat([image[:, :0], *sums], 1)
        self.noise = (box_sum(joined_sums, 2 * window + 1) if sums else joined_sums).permute(0, 2, 3, 1)

    def windows(self, rows: slice, columns: slice) -> Windows:
        """Cut the windows of some rows and columns."""
        side, count = 2 * self.window + 1, self.dimensions - 2
        cut = self.padded
        if not exporting():
            tall = slice(rows.start, rows.stop + 2 * self.window)
            cut = cut[..., tall, columns.start : columns.stop + 2 * self.window]
        views = cut.unfold(2, side, 1).unfold(3, side, 1)
        shape = (views.shape[0], views.shape[2], views.shape[3])
        every = views.permute(0, 2, 3, 1, 4, 5).flatten(4, 5).flatten(0, 2)
        middle = every[..., side * side // 2]
        inside, known = every[:, -1:], middle[:, -1:] > 0
        color = every[:, count : count + 3]
        mean = color.sum(-1) / inside.sum(-1).clamp_min(1.0)
        steps = torch.arange(side, device=self.device, dtype=cut.dtype) - self.window
        places = torch.stack([steps.repeat(side), steps.repeat_interleave(side)])
        places = places + torch.zeros_like(every[:, :1])
        relative = torch.cat([places, every[:, :count] - middle[:, :count, None]], 1)
        return Windows(
            relative,
            self.groups,
            color,
            every[:, count + 3 : count + 4],
            inside,
            self.noise[:, rows, columns].flatten(0, 2),
            torch.where(known, middle[:, count : count + 3], mean),
            known,
            shape,
        )


def in_blocks(
    function: Callable[[slice, slice], tuple[Tensor, ...]], size: tuple[int, int], pixels: int
) -> list[Tensor]:
    """Return the maps (B, H, W, …) of a function of rows and columns, called with at most so many pixels."""
    height, width = size
    if exporting():
        return list(function(slice(None), slice(None)))
    across = min(width, pixels)
    down = max(1, pixels // width)
    strips = []
    for top in range(0, height, down):
        rows = slice(top, min(height, top + down))
        parts = [function(rows, slice(left, min(width, left + across))) for left in range(0, width, across)]
        strips.append([torch.cat(maps, 2) for maps in zip(*parts, strict=True)])
    return [torch.cat(maps, 1) for maps in zip(*strips, strict=True)]
