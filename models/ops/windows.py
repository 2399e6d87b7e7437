"""Cutting an image into blocks of pixels and the overlapping windows around them, a few rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

_LOCAL_BLOCK = 8
"""Side of the blocks whose local windows are cut as one: large enough for matrices that processors multiply
well, small enough that most of the common window belongs to most queries."""

_CHUNK_BYTES = {"cpu": 4 << 20}
"""Size of a chunk's keys on a CPU: they, the values and the scores stay near its second-level caches."""

_CHUNK_BYTES_ELSEWHERE = 256 << 20
"""On other devices, where few large products are wanted."""


@dataclass(frozen=True)
class Windows:
    """Which pixels a query attends to.

    Attributes:
        heads: Attention heads; head h owns the h-th run of channels.
        block: Side of the blocks of queries that share a window; for local windows only how many are
            computed together.
        halo: Pixels of the window on each side of the block, or of the query for local windows.
        local: Every query attends only to the 2 halo + 1 pixels square that is centred on it.
        mask_halo: Pixels outside the image take no part.
    """

    heads: int
    block: int = _LOCAL_BLOCK
    halo: int = 3
    local: bool = False
    mask_halo: bool = False

    @property
    def side(self) -> int:
        """Side of the window that the queries of a block read."""
        return self.block + 2 * self.halo

    @property
    def own(self) -> tuple[int, int]:
        """Side of the squares of queries that have the same keys, and side of the square of those keys."""
        return (1, 2 * self.halo + 1) if self.local else (self.block, self.side)


@dataclass(frozen=True)
class Chunk:
    """Some rows of blocks of some images (B, H, W, C).

    Attributes:
        windows: How the image is cut.
        size: Rows and columns of the image; blocks at its end may reach over it.
        some: Images of the batch.
        first: First row of blocks.
        rows: Number of rows of blocks.
    """

    windows: Windows
    size: tuple[int, int]
    some: slice
    first: int
    rows: int

    @property
    def across(self) -> int:
        """Number of blocks side by side."""
        return -(-self.size[1] // self.windows.block)

    def queries(self, image: Tensor) -> Tensor:
        """Return a copy of the blocks, (N, block², d) with N = images, rows, columns and heads."""
        block, heads = self.windows.block, self.windows.heads
        strip = self._strip(image, 0).unflatten(1, (-1, block)).unflatten(3, (-1, block))
        blocks = strip.unflatten(5, (heads, -1)).permute(0, 1, 3, 5, 2, 4, 6)
        return blocks.contiguous().view(-1, block * block, blocks.shape[-1])

    def keys(self, image: Tensor, position: Tensor | None = None) -> Tensor:
        """Return a copy of the windows (N, side², d), plus (side², d); 0 outside the image."""
        block, side, heads = self.windows.block, self.windows.side, self.windows.heads
        strip = self._strip(image, self.windows.halo).unfold(1, side, block).unfold(2, side, block)
        cut = strip.unflatten(3, (heads, -1)).permute(0, 1, 2, 3, 5, 6, 4)
        copy = torch.empty(cut.shape, dtype=image.dtype, device=image.device)
        if position is None:
            copy.copy_(cut)
        else:
            torch.add(cut, position.view(side, side, -1), out=copy)
        return copy.view(-1, side * side, copy.shape[-1])

    def store(self, image: Tensor, blocks: Tensor) -> None:
        """Write blocks (N, block², d) to their place in (B, H, W, C)."""
        block, heads = self.windows.block, self.windows.heads
        count, top = self.some.stop - self.some.start, self.first * block
        shape = (count, self.rows, self.across, heads, block, block, blocks.shape[-1])
        cut = blocks.view(shape).permute(0, 1, 4, 2, 5, 3, 6)
        target = image[self.some, top : top + self.rows * block]
        if target.shape[1] == self.rows * block and target.shape[2] == self.across * block:
            target.unflatten(1, (-1, block)).unflatten(3, (-1, block)).unflatten(5, (heads, -1)).copy_(cut)
        else:
            strip = cut.flatten(5).flatten(3, 4).flatten(1, 2)
            target.copy_(strip[:, : target.shape[1], : target.shape[2]])

    def outside(self, device: torch.device) -> Tensor:
        """Return which keys lie outside the image, (images * rows * columns, 1 or block², keys).

        Keys are the pixels of the block's window, or those of the query's own window.
        """
        block, side, halo = self.windows.block, self.windows.side, self.windows.halo
        axes = []
        for first, count, length in ((self.first, self.rows, self.size[0]), (0, self.across, self.size[1])):
            start = torch.arange(first, first + count, device=device) * block - halo
            place = start[:, None] + torch.arange(side, device=device)
            axes.append((place < 0) | (place >= length))
        outside = axes[0][:, None, :, None] | axes[1][None, :, None, :]
        outside = outside.reshape(-1, 1, side * side).repeat(self.some.stop - self.some.start, 1, 1)
        if not self.windows.local:
            return outside
        where = local_offsets(self.windows, device)
        return outside.expand(-1, block * block, -1).gather(2, where.expand(len(outside), -1, -1))

    def _strip(self, image: Tensor, halo: int) -> Tensor:
        """Return these rows of blocks with `halo` pixels on all sides, 0 outside the image."""
        block, (height, width) = self.windows.block, self.size
        top, bottom = self.first * block - halo, (self.first + self.rows) * block + halo
        left, right = halo, self.across * block + halo - width
        inside = image[self.some, max(top, 0) : min(bottom, height)]
        if not (left or right or top < 0 or bottom > height):
            return inside
        padding = (0, 0, left, right, max(-top, 0), max(bottom - height, 0))
        return F.pad(inside, padding)


def chunks(image: Tensor, windows: Windows) -> Iterator[Chunk]:
    """Cut images (B, H, W, C) into chunks whose windows take about `_CHUNK_BYTES`, top to bottom."""
    batch, height, width, channels = image.shape
    down, across = -(-height // windows.block), -(-width // windows.block)
    limit = _CHUNK_BYTES.get(image.device.type, _CHUNK_BYTES_ELSEWHERE)
    row_bytes = across * windows.side**2 * channels * image.element_size()
    images = max(1, min(batch, limit // row_bytes))
    rows = max(1, min(down, limit // (row_bytes * images)))
    for start in range(0, batch, images):
        some = slice(start, min(batch, start + images))
        for first in range(0, down, rows):
            yield Chunk(windows, (height, width), some, first, min(rows, down - first))


def local_offsets(windows: Windows, device: torch.device) -> Tensor:
    """Return the places (block², own²) in a block's window of the pixels of each query's own window."""
    block, own, side = windows.block, windows.own[1], windows.side
    along = torch.arange(block, device=device)[:, None] + torch.arange(own, device=device)
    places = along[:, None, :, None] * side + along[None, :, None, :]
    return places.reshape(block * block, own * own)


class WindowSum:
    """The adjoint of `Chunk.keys`: overlapping windows are added up to an image.

    Chunks must come in the order of `chunks`. Rows that no later window reaches are written out at once, so
    that beside the image only a strip exists.

    Args:
        like: An image (B, H, W, C); the sum has its shape.
        windows: How the image is cut.
    """

    def __init__(self, like: Tensor, windows: Windows) -> None:
        self.image = torch.empty_like(like, memory_format=torch.contiguous_format)
        self.windows = windows
        self._strip = like.new_empty(0)

    def add(self, blocks: Tensor, chunk: Chunk) -> None:
        """Add windows (N, side², d) of a chunk."""
        block, side, halo = self.windows.block, self.windows.side, self.windows.halo
        count, done = chunk.some.stop - chunk.some.start, chunk.rows * block
        shape = (count, chunk.rows, chunk.across, self.windows.heads, side, side, blocks.shape[-1])
        cut = blocks.view(shape).permute(0, 1, 4, 2, 5, 3, 6)
        # A block more than the windows need: the last parts below are narrower than a block.
        rest, columns = side, chunk.across * block + side
        strip = self.image.new_zeros(count, done + rest, columns, self.image.shape[-1])
        if chunk.first:
            strip[:, :rest] = self._strip
        # Windows are `block` apart, so equal parts of them, at most that large, do not overlap.
        for top in range(0, side, block):
            for left in range(0, side, block):
                part = cut[:, :, top : top + block, :, left : left + block]
                across = chunk.across * block
                target = strip[:, top : top + done, left : left + across].unflatten(1, (-1, block))
                target = target.unflatten(3, (-1, block)).unflatten(5, (self.windows.heads, -1))
                target[:, :, : part.shape[2], :, : part.shape[4]].add_(part)
        height, width = chunk.size
        begin = chunk.first * block - halo
        last = (chunk.first + chunk.rows) * block >= height
        end = height if last else max(0, begin + done)
        start = max(0, begin)
        inside = strip[:, start - begin : end - begin, halo : halo + width]
        self.image[chunk.some, start:end] = inside
        self._strip = strip[:, done:]
