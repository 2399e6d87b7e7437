"""Pixels of the preceding frame that show what a pixel shows now, and what they remember.

With the motion m of pixel p (previous pixel minus this one), p + m lies between up to four pixels q of the
preceding frame. Each has its bilinear share s_q; one that lies outside the image, or that shows another
surface, has none. What the others remember is averaged,

    h(p) = sum_q s_q h_q / sum_q s_q

which is nothing where no neighbour is left. Motion that is not a number leads nowhere.

Sources: Koskela et al. 2019 (doi:10.1145/3269978), Schied et al. 2017 (doi:10.1145/3105762.3105770). The same
rule as `data.temporal`, for batches of tensors and with tests that the caller chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.ops.precision import wide

FOOTPRINTS = 6.0
"""Automatic position limit in footprints of the frame: that of `data.temporal.POSITION_LIMIT_FOOTPRINTS`."""


@dataclass(frozen=True)
class Neighbours:
    """K pixels of the preceding frame for each pixel of this one.

    Attributes:
        index: Which, row by row, within the image wherever `share` is not 0, (B, K, H, W).
        share: Weight of each, at least 0, (B, K, H, W).
    """

    index: Tensor
    share: Tensor

    @property
    def total(self) -> Tensor:
        """Sum of the shares (B, 1, H, W)."""
        return self.share.sum(1, keepdim=True)

    def of(self, planes: Tensor, k: int) -> Tensor:
        """Return what the k-th neighbours hold in planes (B, C, H, W) of the preceding frame."""
        flat = planes.flatten(2)
        index = self.index[:, k].flatten(1)[:, None].expand(-1, flat.shape[1], -1)
        return flat.gather(2, index).unflatten(2, planes.shape[-2:])

    def distances(self, now: Tensor, before: Tensor) -> Tensor:
        """Return squared distances of vectors (B, C, H, W) from those of all neighbours, (B, K, H, W)."""
        count = self.index.shape[1]
        return torch.stack([(now - self.of(before, k)).square().sum(1) for k in range(count)], 1)

    def only(self, accepted: Tensor) -> Neighbours:
        """Return them without those that are not accepted, (B, K, H, W)."""
        return replace(self, share=self.share * accepted)

    def away_from_border(self, margin: int, size: tuple[int, int]) -> Tensor:
        """Return which neighbours have `margin` pixels of an image of this size around them, (B, K, H, W)."""
        height, width = size
        row, column = self.index // width, self.index % width
        within = (row >= margin) & (row < height - margin)
        return within & (column >= margin) & (column < width - margin)

    def mean(self, planes: Tensor) -> Tensor:
        """Return the weighted mean of planes (B, C, H, W) over the neighbours, 0 where there are none."""
        total = self.total
        sums = torch.zeros_like(planes)
        for k in range(self.index.shape[1]):
            sums = torch.addcmul(sums, self.share[:, k : k + 1], self.of(planes, k))
        return sums / torch.where(total > 0, total, 1.0)


def bilinear(motion: Tensor) -> Neighbours:
    """Return the four neighbours of every pixel's place in the preceding frame.

    Args:
        motion: Previous pixel minus this pixel, x to the right and y down, (B, 2, H, W).
    """
    place, size = _places(motion), motion.shape[-2:]
    corner = place.floor()
    fraction = place - corner
    column, row = corner.long().unbind(1)
    right, down = fraction.unbind(1)
    across = (1 - right, right)
    along = (1 - down, down)
    found = [_inside(row + y, column + x, along[y] * across[x], size) for y in (0, 1) for x in (0, 1)]
    return _joined(found)


def surrounding(motion: Tensor, radius: int = 1) -> Neighbours:
    """Return the square of (2 radius + 1)^2 pixels around every pixel's nearest place, each with share 1.

    Args:
        motion: As in `bilinear`.
        radius: Half the side.
    """
    size = motion.shape[-2:]
    column, row = (_places(motion) + 0.5).floor().long().unbind(1)
    one = torch.ones_like(wide(motion)[:, 0])
    steps = range(-radius, radius + 1)
    return _joined([_inside(row + y, column + x, one, size) for y in steps for x in steps])


def footprint(position: Tensor) -> Tensor:
    """Return the usual distance of neighbouring points of a frame, (B, 1, 1, 1), in scene units.

    It is the median, over the pixels that hit something, of the distance to the right or lower neighbour,
    whichever is closer: near the width of a pixel, since surfaces are rarely oblique in both directions. 1
    where no two neighbours hit anything.

    Args:
        position: First hits (B, 3, H, W), exactly 0 where nothing was hit.
    """
    position = wide(position.detach())
    hit = (position != 0).any(1)
    smallest = torch.full_like(position[:, 0], torch.inf)
    for axis in (-1, -2):
        length = position.shape[axis] - 1
        one, other = (position.narrow(axis, start, length) for start in (0, 1))
        both = hit.narrow(axis, 0, length) & hit.narrow(axis, 1, length)
        distance = (one - other).square().sum(1).sqrt()
        distance = torch.where(both & (distance > 0), distance, torch.inf)
        part = smallest.narrow(axis, 0, length)
        part.copy_(torch.minimum(part, distance))
    # `nanmedian` leaves out what no neighbour told.
    median = torch.where(smallest.isfinite(), smallest, torch.nan).flatten(1).nanmedian(1).values
    return torch.nan_to_num(median, 1.0)[:, None, None, None]


def position_limit(position: Tensor, squared: float | None) -> Tensor:
    """Return the squared distance below which two points are one surface's, (B, 1, 1, 1) or ().

    Args:
        position: First hits (B, 3, H, W) of this frame.
        squared: The limit in squared scene units; None: `FOOTPRINTS` footprints of the frame.
    """
    if squared is None:
        return (FOOTPRINTS * footprint(position)).square()
    return torch.full((), squared, dtype=wide(position).dtype, device=position.device)


def _places(motion: Tensor) -> Tensor:
    """Return column and row (B, 2, H, W) in the preceding frame, (-2, -2) for what is far outside."""
    motion = wide(motion)
    height, width = motion.shape[-2:]
    columns = torch.arange(width, dtype=motion.dtype, device=motion.device)
    rows = torch.arange(height, dtype=motion.dtype, device=motion.device)
    place = motion + torch.stack([columns.expand(height, -1), rows[:, None].expand(-1, width)])
    x, y = place.unbind(1)
    near = (x >= -1) & (x < width) & (y >= -1) & (y < height)
    return torch.where(near[:, None], place, -2.0)


def _inside(row: Tensor, column: Tensor, share: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    height, width = size
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return index, torch.where(inside, share, 0.0)


def _joined(found: list[tuple[Tensor, Tensor]]) -> Neighbours:
    index, share = zip(*found, strict=True)
    return Neighbours(torch.stack(index, 1), torch.stack(share, 1))
