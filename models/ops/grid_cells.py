"""Cells of a bilateral grid: which lie around a pixel, and what they weigh.

A grid has a cell for every s x s pixels and every r levels of a guide that runs from 0 to 255; the middle of
cell (u, v, d) lies at (u + 0.5, v + 0.5, d + 0.5). With the tent t(x) = max(0, 1 - sqrt(x^2 + 1e-8)), pixel
(x, y) of guide g and cell (u, v, d) have the weight

    w = t((x + 0.5) / s - u - 0.5)  t((y + 0.5) / s - v - 0.5)  t((g + 0.5) / r - d - 0.5)

which is above 0 for eight cells at most. `models.ops.bilateral_grid` says what they are for.

Source: Meng et al. 2020 (doi:10.2312/sr.20201133), formulas as in the authors' code.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

LEVELS = 256
"""Levels of the guide that cells share out."""

_ROUNDED = 1e-8
"""Rounds the tip of the tent, so that its slope has no jump there."""

_CHUNK = 1 << 15
"""Pixels processed at once on a CPU: what is made of them for one cell after the other takes 2 MB."""

_CHUNK_DEVICE = 1 << 20
"""The same on other devices, where calls cost more and memory less."""


class Cells(NamedTuple):
    """The size of the cells of a grid.

    Attributes:
        space: Pixels along each side of a cell.
        depth: Levels of the guide in a cell, a divisor of 256 and at most half of it.
    """

    space: int
    depth: int

    @property
    def reach(self) -> int:
        """Pixels beyond a core, cut where cells begin, that what is read there depends on: half a cell beyond
        the core lies the middle of the next one, which sees pixels less than a whole cell away."""
        return self.space // 2 + self.space

    def counts(self, guide: Tensor) -> tuple[int, int, int]:
        """Return the number of cells down, across and deep for a guide (..., H, W)."""
        height, width = guide.shape[-2:]
        return height // self.space, width // self.space, LEVELS // self.depth

    def check(self, guide: Tensor, image: tuple[int, ...]) -> None:
        """Refuse impossible cells, and a guide or an image (B, C, H, W) that does not fit.

        Raises:
            ValueError: Says what was expected and what came.
        """
        space, depth = self
        if space < 1 or depth < 1 or LEVELS % depth or depth > LEVELS // 2:
            raise ValueError(
                f"cells of {space} pixels and {depth} levels; expected at least one of each, and levels that "
                f"divide {LEVELS} into two cells or more"
            )
        batch, _, height, width = image
        if tuple(guide.shape) != (batch, 1, height, width):
            raise ValueError(
                f"the guide has shape {tuple(guide.shape)}, expected {(batch, 1, height, width)} for an "
                f"image of shape {tuple(image)}"
            )
        if height % space or width % space:
            raise ValueError(f"an image of {width}x{height}; expected sides that are multiples of {space}")


class _Side(NamedTuple):
    """The two cells around the pixels along a side.

    Attributes:
        cell: (2, N); the nearest where there is none beyond the image.
        weight: (2, N), 0 there.
    """

    cell: Tensor
    weight: Tensor


Taps = Iterator[tuple[Tensor, Tensor]]
"""Of each of four pairs of cells around pixels: index of the lower one into flattened cells, after which the
upper one follows, and weight of both in row and column."""


WEIGHT, SLOPE = (False,), (True,)
"""What may be asked for: weights, their slopes in the guide, or, as a sum of these, both."""


class Piece(NamedTuple):
    """Some pixels and the cells around them: h rows of n images.

    Attributes:
        images: Which of the batch.
        rows: Which of their rows.
        depths: Weights of both in depth, or slopes of these, as asked for, (2, n, h, W). Times the weight
            in row and column it is the whole weight.
        taps: The cells; indices (n * h * W,) into all cells of the batch, weights (h, W).
    """

    images: slice
    rows: slice
    depths: list[Tensor]
    taps: Taps


def pieces(guide: Tensor, cells: Cells, slopes: tuple[bool, ...] = WEIGHT) -> Iterator[Piece]:
    """Return all pixels, piece by piece, with the cells around them.

    Args:
        guide: (B, 1, H, W).
        cells: Size of the cells.
        slopes: What is asked for.
    """
    batch, _, height, width = guide.shape
    down, across = _side(height, cells.space, guide), _side(width, cells.space, guide)
    counts = cells.counts(guide)
    before = _before(guide, counts)
    limit = _CHUNK if guide.device.type == "cpu" else _CHUNK_DEVICE
    together, step = max(1, limit // (height * width)), max(1, limit // width)
    for first in range(0, height, step):
        rows = slice(first, min(height, first + step))
        planes = _planes(_Side(down.cell[:, rows], down.weight[:, rows]), across, counts)
        for image in range(0, batch, together):
            images = slice(image, min(batch, image + together))
            low, depths = _depths(guide[images, 0, rows], counts[2], slopes)
            yield Piece(images, rows, depths, _taps(low + before[images], planes))


def around_all(guide: Tensor, cells: Cells) -> Iterator[tuple[Tensor, Tensor]]:
    """Return the cells around all pixels at once, in a form that a recorded graph can hold for every size.

    Args:
        guide: (B, 1, H, W).
        cells: Size of the cells.

    Returns:
        Index (B * H * W,) into all cells of the batch, and weight (B * H * W, 1).
    """
    down, across = _side(guide.shape[2], cells.space, guide), _side(guide.shape[3], cells.space, guide)
    counts = cells.counts(guide)
    low, depths = _depths(guide[:, 0], counts[2], WEIGHT)
    for index, area in _taps(low + _before(guide, counts), _planes(down, across, counts)):
        for upper in range(2):
            yield index + upper, (area * depths[0][upper]).reshape(-1, 1)


def _before(guide: Tensor, counts: tuple[int, int, int]) -> Tensor:
    """Return the number of cells of all images before each of the batch, (B, 1, 1)."""
    images = torch.arange(guide.shape[0], device=guide.device)[:, None, None]
    return images * (counts[0] * counts[1] * counts[2])


def _side(count: int, space: int, like: Tensor) -> _Side:
    place = (torch.arange(count, device=like.device).to(like.dtype) + 0.5) / space - 0.5
    cell = torch.floor(place).long() + torch.arange(2, device=like.device)[:, None]
    below = cell < count // space
    weight = _tent(place - cell)[0] * (below & (cell >= 0))
    return _Side(torch.where(below, cell, cell - 1).clamp_min(0), weight)


def _planes(down: _Side, across: _Side, counts: tuple[int, int, int]) -> list[tuple[Tensor, Tensor]]:
    """Return, of four stacks of cells, index of the first and weight of all, (rows, columns)."""
    _, columns, deep = counts
    return [
        (
            (down.cell[v, :, None] * columns + across.cell[u]) * deep,
            down.weight[v, :, None] * across.weight[u],
        )
        for v in range(2)
        for u in range(2)
    ]


def _tent(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the tent at a distance, and the rounded distance."""
    rounded = (distance.square() + _ROUNDED).sqrt()
    return (1.0 - rounded).clamp_min(0.0), rounded


def _depths(guide: Tensor, deep: int, slopes: tuple[bool, ...]) -> tuple[Tensor, list[Tensor]]:
    """Return the lower of the two cells in depth, and what is asked for of both."""
    place = (guide + 0.5) * (deep / LEVELS) - 0.5
    # At the ends of the guide there is one cell only; the tent is 0 at the other of these two.
    low = torch.nan_to_num(torch.floor(place).clamp(0.0, deep - 2.0), 0.0)
    near = place - low
    near = torch.stack([near, near - 1.0])
    tent, rounded = _tent(near)
    depths = [near / rounded * (tent > 0) * (-deep / LEVELS) if slope else tent for slope in slopes]
    return low.long(), depths


def _taps(low: Tensor, planes: list[tuple[Tensor, Tensor]]) -> Taps:
    for first, area in planes:
        yield (low + first).reshape(-1), area
