"""Bilateral grids: an image splatted into cells of position and guide, and read out again.

Pixels and cells have weights w, tents in column, row and guide (`models.ops.grid_cells`). Both operators are
weighted means,

    cell = sum_pixels w image / sum_pixels w,      pixel = sum_cells w cell / sum_cells w,

0 where the sum of weights is 0. Reading leaves out, channel by channel, cells whose value is not above 0:
those that no pixel reached, and black ones.

Source: Meng et al. 2020 (doi:10.2312/sr.20201133), formulas as in the authors' code.

Written down plainly, indices, weights and products of all eight cells around every pixel are kept for the
backward pass. Here they are formed for one cell and some rows at a time, and formed again. Everything runs
in float32, or float64 for float64 images, also under mixed precision, and is differentiable once, with
respect to image or grid and guide.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import exporting
from models.ops.grid_cells import SLOPE, WEIGHT, Cells, around_all, pieces
from models.ops.precision import wide


def create_grid(image: Tensor, guide: Tensor, cells: Cells, limit: float | None = None) -> Tensor:
    """Splat an image into a bilateral grid.

    Args:
        image: (B, C, H, W), sides multiples of `cells.space`.
        guide: (B, 1, H, W), from 0 to 255.
        cells: Size of the cells.
        limit: Elements of the gradients of image and guide that are larger, with either sign, become 0, as in
            the authors' code; None: the gradients are left as they are.

    Returns:
        Weighted means (B, C, H / space, W / space, 256 / depth), 0 in cells that no pixel reaches.

    Raises:
        ValueError: Sizes differ or are no multiples, or the cells are impossible.
    """
    image = wide(image)
    guide = guide.to(image.dtype)
    if exporting():
        return _create_exported(image, guide, cells)
    cells.check(guide, image.shape)
    if torch.is_grad_enabled() and (image.requires_grad or guide.requires_grad):
        made: Tensor = _Create.apply(image, guide, cells, limit)
        return made
    return _means(_scatter(_with_ones(image), guide, cells))[0]


def slice_grid(grid: Tensor, guide: Tensor, cells: Cells, limit: float | None = None) -> Tensor:
    """Read a bilateral grid at every pixel; cells that are not above 0 in a channel do not count there.

    Args:
        grid: (B, C, H / space, W / space, 256 / depth).
        guide: (B, 1, H, W), from 0 to 255.
        cells: Size of the cells.
        limit: As in `create_grid`, for the gradients of grid and guide.

    Returns:
        (B, C, H, W); 0 where no cell around a pixel counts.

    Raises:
        ValueError: As for `create_grid`.
    """
    grid = wide(grid)
    guide = guide.to(grid.dtype)
    if exporting():
        return _slice_exported(grid, guide, cells)
    cells.check(guide, tuple(guide.shape))
    expected = (guide.shape[0], grid.shape[1], *cells.counts(guide))
    if tuple(grid.shape) != expected:
        raise ValueError(f"a grid has shape {tuple(grid.shape)}, expected {expected}")
    if torch.is_grad_enabled() and (grid.requires_grad or guide.requires_grad):
        made: Tensor = _Slice.apply(grid, guide, cells, limit)
        return made
    return _read(grid, guide, cells)[0]


def _with_ones(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], 1)


def _divisor(weight: Tensor) -> Tensor:
    """Return the weight, infinite where it is 0: what is divided by it is 0 there."""
    return weight.masked_fill(weight == 0, torch.inf)


def _means(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Return means, and what they were divided by, of sums whose last channel is the weight."""
    divisor = _divisor(sums[:, -1:])
    return sums[:, :-1] / divisor, divisor


def _read(
    grid: Tensor, guide: Tensor, cells: Cells, slopes: bool = False
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return pixels, what they were divided by, and their slopes in the guide, (B, C, H, W) each."""
    parts = _gather(grid, guide, cells, WEIGHT + SLOPE if slopes else WEIGHT, counted=True)
    total, weight = parts[0].chunk(2, 1)
    divisor = _divisor(weight)
    made = total / divisor
    if not slopes:
        return made, divisor, None
    steep, counts = parts[1].chunk(2, 1)
    return made, divisor, (steep - made * counts) / divisor


def _limited(gradient: Tensor, limit: float | None) -> Tensor:
    return gradient if limit is None else gradient.masked_fill_(gradient.abs() > limit, 0.0)


class _Create(torch.autograd.Function):
    """`create_grid` with a backward pass that forms indices and weights again.

    With cells c, sums of weights W, incoming gradients g, h = g / W, dw the slope of a weight in the guide:

        dL/d(image) = sum_cells w h,      dL/d(guide) = sum_cells dw <h, image - c>
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, guide: Tensor, cells: Cells, limit: float | None) -> Tensor:
        grid, divisor = _means(_scatter(_with_ones(image), guide, cells))
        ctx.save_for_backward(image, guide, grid, divisor)
        ctx.cells, ctx.limit = cells, limit
        return grid

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        image, guide, grid, divisor = ctx.saved_tensors
        for_image, for_guide = ctx.needs_input_grad[:2]
        channels, d_image, d_guide = grid.shape[1], None, None
        # h and <h, c> side by side, channels outermost in memory as `_gather` reads them.
        both = grid.new_zeros(channels + 1, grid.shape[0], *grid.shape[2:]).transpose(0, 1)
        share, product = both[:, :channels], both[:, channels]
        torch.div(gradient, divisor, out=share)
        if for_image:
            d_image = _limited(_gather(share, guide, ctx.cells)[0], ctx.limit)
        if for_guide:
            for channel in range(channels):
                product.addcmul_(share[:, channel], grid[:, channel])
            steep = _gather(both, guide, ctx.cells, SLOPE)[0]
            d_guide = (steep[:, :-1] * image).sum(1, keepdim=True).sub_(steep[:, -1:])
            d_guide = _limited(d_guide, ctx.limit)
        return d_image, d_guide, None, None


class _Slice(torch.autograd.Function):
    """`slice_grid` with a backward pass that forms indices and weights again.

    With pixels p, sums of weights W, incoming gradients g and h = g / W, over cells c that count:

        dL/d(cell) = sum_pixels w h,      dL/d(guide) = sum_cells dw <h, c - p>

    What g is multiplied with in the second is formed with p, for which cells are looked up anyhow.
    """

    @staticmethod
    def forward(ctx: Any, grid: Tensor, guide: Tensor, cells: Cells, limit: float | None) -> Tensor:
        made, divisor, steep = _read(grid, guide, cells, ctx.needs_input_grad[1])
        for_grid = ctx.needs_input_grad[0]
        ctx.save_for_backward(guide, *((grid, divisor) if for_grid else (None, None)), steep)
        ctx.cells, ctx.limit = cells, limit
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        guide, grid, divisor, steep = ctx.saved_tensors
        d_grid = d_guide = None
        if grid is not None:
            d_grid = _scatter(gradient / divisor, guide, ctx.cells).mul_(grid > 0)
            d_grid = _limited(d_grid, ctx.limit)
        if steep is not None:
            d_guide = _limited((gradient * steep).sum(1, keepdim=True), ctx.limit)
        return d_grid, d_guide, None, None


def _scatter(values: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """Return sum_pixels w values, (B, C, v, u, d), of values (B, C, H, W); channels outermost in memory."""
    batch, channels = values.shape[:2]
    counts = cells.counts(guide)
    sums = values.new_zeros(channels, batch * counts[0] * counts[1] * counts[2])
    for piece in pieces(guide, cells):
        some = values[piece.images, :, piece.rows].transpose(0, 1)
        parts = [some * depth for depth in piece.depths[0]]
        for index, area in piece.taps:
            for upper, part in enumerate(parts):
                sums[:, upper:].index_add_(1, index, (part * area).flatten(1))
    return sums.unflatten(1, (batch, *counts)).transpose(0, 1)


def _gather(
    grid: Tensor, guide: Tensor, cells: Cells, slopes: tuple[bool, ...] = WEIGHT, counted: bool = False
) -> list[Tensor]:
    """Return sum_cells w cell of a grid (B, C, v, u, d), (B, C, H, W), once for all that is asked for.

    Args:
        grid: What is gathered.
        guide: As in `slice_grid`.
        cells: As in `slice_grid`.
        slopes: Whether w are weights or their slopes, as `models.ops.grid_cells.pieces` takes it.
        counted: Leave out what is not above 0, and return also what the weights of the rest add up to,
            (B, 2 C, H, W).
    """
    batch, channels = grid.shape[:2]
    flat = grid.transpose(0, 1).flatten(1)
    flat = flat.clamp_min(0.0) if counted else flat
    made = [grid.new_empty(channels * (1 + counted), batch, *guide.shape[2:]) for _ in slopes]
    for piece in pieces(guide, cells, slopes):
        # Row and column first, for both cells in depth; then depth, for all that is asked for.
        sums = flat.new_zeros(2, channels * (1 + counted), *piece.depths[0].shape[1:])
        for index, area in piece.taps:
            for upper, some in enumerate(sums):
                # Selecting from `flat[:, upper:]` would copy the whole grid first.
                values = flat.index_select(1, index + upper if upper else index).view_as(some[:channels])
                some[:channels].addcmul_(values, area)
                if counted:
                    some[channels:].addcmul_(values.sign_(), area)
        for part, depth in zip(made, piece.depths, strict=True):
            part[:, piece.images, piece.rows] = (sums[0] * depth[0]).addcmul_(sums[1], depth[1])
    return [part.transpose(0, 1) for part in made]


def _create_exported(image: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """The same as one graph for every size."""
    channels = image.shape[1] + 1
    pixels = _with_ones(image).permute(0, 2, 3, 1).reshape(-1, channels)
    down, across, deep = cells.counts(guide)
    sums = torch.zeros(image.shape[0] * down * across * deep, channels).to(image)
    for index, weight in around_all(guide, cells):
        sums = sums.scatter_add(0, index[:, None].expand(-1, channels), pixels * weight)
    return _means(sums.reshape(-1, down, across, deep, channels).permute(0, 4, 1, 2, 3))[0]


def _slice_exported(grid: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """The same as one graph for every size."""
    channels = grid.shape[1]
    flat = grid.clamp_min(0.0).permute(0, 2, 3, 4, 1).reshape(-1, channels)
    flat = torch.cat([flat, (flat > 0).to(flat.dtype)], 1)
    total = torch.zeros_like(flat[:1])
    for index, weight in around_all(guide, cells):
        total = total + flat.index_select(0, index) * weight
    total = total.reshape(-1, guide.shape[2], guide.shape[3], 2 * channels).permute(0, 3, 1, 2)
    return total[:, :channels] / _divisor(total[:, channels:])
