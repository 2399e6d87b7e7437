"""How steeply an image rises from a pixel to its neighbours, on whole images.

Graphics hardware takes differences within squares of 2x2 pixels, so that at a silhouette every second pixel
sees a cliff where its own surface is flat. Here the differences from the neighbour before and to the one
behind are compared, and the smaller one counts: of the two sides of a pixel one lies on its own surface. At
the border of the image it is compared with the next pair's.
"""

from __future__ import annotations

import torch
from torch import Tensor


def slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slopes to the right and downwards per pixel, each (B, C, H, W).

    Every channel by itself; 0 along a side of one pixel.

    Args:
        image: (B, C, H, W).
    """
    return _along(image, -1), _along(image, -2)


def variation(image: Tensor) -> Tensor:
    """Return the length over the channels of |slope to the right| + |slope downwards|, (B, 1, H, W)."""
    right, down = slopes(image)
    return (right.abs() + down.abs()).square().sum(1, keepdim=True).sqrt()


def _along(image: Tensor, axis: int) -> Tensor:
    count = image.shape[axis] - 1
    if count == 0:
        return torch.zeros_like(image)
    difference = image.diff(dim=axis)
    # At the border there is one neighbour only: the next difference stands for the one that is missing, or
    # the cliff between a last pixel and its neighbour would be a slope.
    behind = torch.cat([difference, difference.narrow(axis, max(count - 2, 0), 1)], axis)
    before = torch.cat([difference.narrow(axis, min(count - 1, 1), 1), difference], axis)
    return torch.where(behind.abs() < before.abs(), behind, before)
