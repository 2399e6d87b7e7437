"""Any denoiser on images of any size: tiles with context, cores stitched without blending.

A tile is cut with the halo that the method declares, so that its core sees all pixels that it depends on;
numbers that need the whole frame are measured once. Tiled equals untiled to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import FRAME_NUMBERS, SAMPLES

BYTES_PER_PIXEL = 500
"""Working memory per pixel where a method does not declare `bytes_per_pixel`: ONNX Runtime was measured to
take 410 for WSKP at 1280x720."""

SMALLEST_CORE = 16
"""Rows and columns of the smallest core: below that nearly all work would be halo."""

DEFAULT_BUDGET = 2 * 1024**3
"""Working memory in bytes where the caller names none: four million pixels in one piece."""


class Tileable(Protocol):
    """What tiling needs of a denoiser; exported artifacts offer the same.

    A method may also declare `bytes_per_pixel` and `bytes_once`, its measured working memory.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the buffers that the method reads."""

    @property
    def frame_numbers(self) -> tuple[str, ...]:
        """Names of the frame numbers that it reads when they are given."""

    @property
    def halo(self) -> int:
        """Pixels that a core on the grid of `multiple` depends on, on each of its sides."""

    @property
    def multiple(self) -> int:
        """Side of the method's own grid, at whose multiples tiles start."""

    def measure(self, buffers: Mapping[str, Tensor], /) -> Mapping[str, Tensor]:
        """Return the numbers that need the whole frame."""

    def __call__(self, buffers: Mapping[str, Tensor], /) -> Any:
        """Return `Denoised`, or the colour alone."""


@dataclass(frozen=True)
class Tile:
    """One tile: where its core lies in the image, and what is read around it.

    Attributes:
        core: Rows and columns that the tile is responsible for.
        read: Rows and columns that are read, halo included; both start at multiples of `multiple`.
    """

    core: tuple[slice, slice]
    read: tuple[slice, slice]


def core_size(denoiser: Tileable, size: tuple[int, int], budget: int, batch: int = 1) -> tuple[int, int]:
    """Return the rows and columns of the cores that fit into a memory budget and read the fewest pixels.

    Halos are read again by every tile, but not beyond the image, so long tiles along the shorter side often
    read less than square ones.

    Args:
        denoiser: Declares `halo`, `multiple` and optionally `bytes_per_pixel` and `bytes_once`.
        size: Height and width of the image, multiples of `multiple`.
        budget: Working memory in bytes.
        batch: Images that are denoised at once.

    Raises:
        ValueError: Not even the smallest tile fits; the message says how much is needed.
    """
    per_pixel = int(getattr(denoiser, "bytes_per_pixel", BYTES_PER_PIXEL)) * batch
    once = int(getattr(denoiser, "bytes_once", 0))
    halo, multiple = aligned_halo(denoiser), denoiser.multiple
    (tall, wide), pixels = size, max(budget - once, 0) // per_pixel
    smallest = _round_up(SMALLEST_CORE, multiple)
    found: list[tuple[int, tuple[int, int]]] = []
    for pieces in range(1, -(-tall // smallest) + 1):
        rows = _even(tall, -(-tall // pieces), multiple)
        room = pixels // min(rows + 2 * halo, tall)
        columns = wide if room >= wide else (room - 2 * halo) // multiple * multiple
        if columns >= min(smallest, wide):
            columns = _even(wide, columns, multiple)
            found.append((_read(tall, rows, halo) * _read(wide, columns, halo), (rows, columns)))
    if not found:
        height, width = (min(smallest + 2 * halo, side) for side in size)
        raise ValueError(
            f"a memory budget of {budget / 1e6:.1f} MB is too small for tiles with a halo of {halo} pixels: "
            f"expected at least {(height * width * per_pixel + once) / 1e6:.1f} MB"
        )
    return min(found)[1]


def _read(size: int, core: int, halo: int) -> int:
    """Return how many rows (or columns) all tiles along a side read together."""
    return sum(min(size, start + core + halo) - max(0, start - halo) for start in range(0, size, core))


def tiles(height: int, width: int, core: tuple[int, int], halo: int) -> Iterator[Tile]:
    """Cut an image into tiles.

    Args:
        height: Rows of the image.
        width: Columns of the image.
        core: Rows and columns of a core; the last ones may be smaller.
        halo: Pixels read around a core, less where the image ends.
    """
    for y in range(0, height, core[0]):
        for x in range(0, width, core[1]):
            down, right = min(height, y + core[0]), min(width, x + core[1])
            read = (
                slice(max(0, y - halo), min(height, down + halo)),
                slice(max(0, x - halo), min(width, right + halo)),
            )
            yield Tile((slice(y, down), slice(x, right)), read)


def denoise_tiled(
    denoiser: Tileable,
    buffers: Mapping[str, Tensor],
    *,
    tile: int | None = None,
    budget: int = DEFAULT_BUDGET,
) -> Tensor:
    """Denoise images of any size within a memory budget; equal to one untiled call to 1e-5.

    Args:
        denoiser: A `models.Denoiser`, or an object with the attributes of `Tileable`. Not recurrent.
        buffers: Tensors (B, C, H, W) for each of its inputs, `samples` (B, S, C, H, W), optionally frame
            numbers (`exposure` …); numbers that `measure` gives and the mapping lacks are measured on these
            images.
        tile: Largest side of a core in pixels, at least the method's multiple; None: from `budget`.
        budget: Working memory of the method in bytes.

    Returns:
        Linear radiance (B, 3, H, W).

    Raises:
        ValueError: A buffer is missing, sizes differ, or the budget is too small.
    """
    batch, height, width = _size(denoiser, buffers)
    numbers = numbers_of_frame(denoiser, buffers)
    multiple = denoiser.multiple
    images = {name: _padded(name, buffers[name], multiple) for name in denoiser.inputs}
    tall, wide = _round_up(height, multiple), _round_up(width, multiple)
    result: Tensor | None = None
    if tile is None:
        core = core_size(denoiser, (tall, wide), budget, batch)
    else:
        core = (_even(tall, max(tile, 1), multiple), _even(wide, max(tile, 1), multiple))
    for piece in tiles(tall, wide, core, aligned_halo(denoiser)):
        rows, columns = piece.read
        part = {name: image[..., rows, columns].contiguous() for name, image in images.items()}
        color = _color(denoiser({**part, **numbers}))
        if result is None:
            result = color.new_empty(batch, 3, tall, wide)
        inner_rows, inner_columns = (
            slice(c.start - r.start, c.stop - r.start) for c, r in zip(piece.core, piece.read, strict=True)
        )
        result[..., piece.core[0], piece.core[1]] = color[..., inner_rows, inner_columns]
    assert result is not None
    return result[..., :height, :width]


def numbers_of_frame(denoiser: Tileable, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the frame numbers that parts of a frame are denoised with: given ones, and measured ones."""
    given = {name: buffers[name] for name in denoiser.frame_numbers if name in buffers}
    return {**denoiser.measure(buffers), **given}


def _size(denoiser: Tileable, buffers: Mapping[str, Tensor]) -> tuple[int, int, int]:
    missing = [name for name in denoiser.inputs if name not in buffers]
    if missing:
        raise ValueError(
            f"the denoiser needs the buffers {', '.join(denoiser.inputs)}; missing: {', '.join(missing)}; "
            f"given: {', '.join(n for n in buffers if n not in FRAME_NUMBERS) or 'none'}"
        )
    shapes = {name: tuple(buffers[name].shape[-2:]) for name in denoiser.inputs}
    if len(set(shapes.values())) > 1:
        listed = ", ".join(f"{name} {w}x{h}" for name, (h, w) in shapes.items())
        raise ValueError(f"buffers of different size: {listed}; expected one size")
    first = buffers[denoiser.inputs[0]]
    return first.shape[0], first.shape[-2], first.shape[-1]


def aligned_halo(denoiser: Tileable) -> int:
    """Round the halo up, so that tiles start where the method's own grid of `multiple` pixels does."""
    return _round_up(denoiser.halo, denoiser.multiple)


def _round_up(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def _even(size: int, largest: int, multiple: int) -> int:
    """Return the core size that cuts `size` into as few and equal pieces as `largest` allows."""
    pieces = -(-size // largest)
    return _round_up(-(-size // pieces), multiple)


def _padded(name: str, image: Tensor, multiple: int) -> Tensor:
    bottom, right = -image.shape[-2] % multiple, -image.shape[-1] % multiple
    if not bottom and not right:
        return image
    if name == SAMPLES:  # pixels without samples, so that nothing from beyond the image is splatted into it
        return F.pad(image, (0, right, 0, bottom), value=torch.nan)
    return F.pad(image, (0, right, 0, bottom), mode="replicate")


def _color(result: Any) -> Tensor:
    color = getattr(result, "color", result)
    if not isinstance(color, torch.Tensor):
        raise TypeError(f"a denoiser returns a tensor or Denoised, got {type(result).__name__}")
    return color
