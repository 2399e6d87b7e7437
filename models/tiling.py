"""Any denoiser on images of any size: tiles with context, cores stitched without blending.

A tile is cut with the halo that the method declares, so that its core sees all pixels that it depends on;
numbers that need the whole frame are measured once. Tiled equals untiled to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import FRAME_NUMBERS, SAMPLES
from models.carried import Carried, continued
from models.denoiser import Denoised, State
from models.pace import Pace, listening

BYTES_PER_PIXEL = 500
"""Working memory per pixel where a method does not declare `bytes_per_pixel`: ONNX Runtime was measured to
take 410 for WSKP at 1280x720."""

SMALLEST_CORE = 16
"""Rows and columns of the smallest core, or as many as the halo has where that is more: below that nearly all
work would be halo. So a pixel is read about nine times at most."""

DEFAULT_BUDGET = 2 * 1024**3
"""Working memory in bytes where the caller names none: four million pixels in one piece."""

Call = Callable[[Mapping[str, Tensor]], Any]
"""A method on the buffers of a tile; returns `Denoised`, or the colour alone."""

Run = Callable[[Call, Mapping[str, Tensor]], Any]
"""Calls a method, such as in another thread or with tiles of other images in one batch."""


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


def core_size(
    denoiser: Tileable, size: tuple[int, int], budget: int, batch: int = 1, samples: int = 0
) -> tuple[int, int]:
    """Return the rows and columns of the cores that fit into a memory budget and read the fewest pixels.

    Halos are read again by every tile, but not beyond the image, so long tiles along the shorter side often
    read less than square ones.

    Args:
        denoiser: Declares `halo`, `multiple` and optionally `bytes_per_pixel` and `bytes_once`.
        size: Height and width of the image, multiples of `multiple`.
        budget: Working memory in bytes.
        batch: Images that are denoised at once; of sequences, all of their frames.
        samples: Numbers per pixel of all samples, of which a tile holds a copy; 0: they are not read.

    Raises:
        ValueError: Not even the smallest tile fits; the message says how much is needed.
    """
    per_pixel = (int(getattr(denoiser, "bytes_per_pixel", BYTES_PER_PIXEL)) + 4 * samples) * batch
    once = int(getattr(denoiser, "bytes_once", 0))
    halo, multiple = aligned_halo(denoiser), denoiser.multiple
    (tall, wide), pixels = size, max(budget - once, 0) // per_pixel
    smallest = _round_up(max(SMALLEST_CORE, halo), multiple)
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


def times_read(denoiser: Tileable, size: tuple[int, int], core: tuple[int, int]) -> float:
    """Return how often a pixel is read on average when an image is cut into these cores; 1: in one piece."""
    halo = aligned_halo(denoiser)
    return _read(size[0], core[0], halo) * _read(size[1], core[1], halo) / (size[0] * size[1])


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
    """Return only the colour of `denoise_in_tiles`, (B, 3, H, W) or (B, T, 3, H, W)."""
    return denoise_in_tiles(denoiser, buffers, tile=tile, budget=budget).color


def denoise_in_tiles(
    denoiser: Tileable,
    buffers: Mapping[str, Tensor],
    *,
    tile: int | None = None,
    budget: int = DEFAULT_BUDGET,
    progress: Callable[[float], None] | None = None,
    pace: Pace | None = None,
    run: Run | None = None,
    state: State | None = None,
) -> Denoised:
    """Denoise images of any size within a memory budget; equal to one untiled call to 1e-5.

    Args:
        denoiser: A `models.Denoiser`, or an object with the attributes of `Tileable`.
        buffers: Tensors (B, C, H, W) for each of its inputs, sequences (B, T, C, H, W) for space-time
            methods, `samples` (B, S, C, H, W), optionally frame numbers (`exposure` …); those that `measure`
            gives and the mapping lacks are measured on these images.
        tile: Largest side of a core in pixels, at least the method's multiple; None: only `budget` limits it.
        budget: Working memory of the method in bytes.
        progress: Called after each tile with the share of the work that is done.
        pace: Of the method, to call `progress` within tiles too.
        run: Calls the method on the buffers of a tile; None: here and now.
        state: Of the frame before, for recurrent methods; None starts a sequence.

    Returns:
        Linear radiance (B, 3, H, W) or all frames (B, T, 3, H, W), and `aux` and `state` where the method
        returns them.

    Raises:
        ValueError: A buffer is missing, sizes differ, or the budget is too small.
    """
    batch, height, width = _size(denoiser, buffers)
    numbers = numbers_of_frame(denoiser, buffers)
    multiple = denoiser.multiple
    tall, wide = _round_up(height, multiple), _round_up(width, multiple)
    call: Call = denoiser
    if getattr(denoiser, "frames", 0):
        call = denoiser.clip  # type: ignore[attr-defined]  # declared by methods with `frames`
    held = buffers[SAMPLES].shape[1:3].numel() if SAMPLES in denoiser.inputs else 0
    cut = not getattr(denoiser, "whole", False)
    core = core_size(denoiser, (tall, wide), budget, batch, held) if cut else (tall, wide)
    if tile is not None and cut:
        rows, columns = (_even(side, max(tile, 1), multiple) for side in (tall, wide))
        core = (min(core[0], rows), min(core[1], columns))
    whole = _Whole((tall, wide))
    for piece in tiles(tall, wide, core, aligned_halo(denoiser)):
        tile_rows, tile_columns = piece.read
        # Padded tile by tile, since a frame of many samples is large.
        part = {
            name: _padded(name, buffers[name][..., tile_rows, tile_columns], multiple).contiguous()
            for name in denoiser.inputs
        }
        with _steps(progress, pace, whole.done, _share(piece, (tall, wide))):
            given = {**part, **numbers}
            step = call if state is None else continued(call, state, piece.read, whole.size)
            result = step(given) if run is None else run(step, given)
        whole.place(piece, result)
        if progress is not None:
            progress(whole.done)
    return whole.cut(height, width)


def _share(piece: Tile, size: tuple[int, int]) -> float:
    rows, columns = piece.core
    return (rows.stop - rows.start) * (columns.stop - columns.start) / (size[0] * size[1])


@contextmanager
def _steps(
    progress: Callable[[float], None] | None, pace: Pace | None, done: float, share: float
) -> Iterator[None]:
    """Tell the steps within a tile that stands for a share of the work."""
    if progress is None or pace is None:
        yield
        return
    steps = 0.0

    def tell(step: float) -> None:
        nonlocal steps
        steps += step
        progress(done + share * pace.share(steps))

    with listening(tell):
        yield


class _Whole:
    """What the tiles of an image are put into, and the share of its pixels that is done."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size, self.done = size, 0.0
        self.layers: dict[str | None, Tensor] = {}
        self.has_aux = False
        self.carried = Carried(size)

    def place(self, piece: Tile, result: Any) -> None:
        """Copy the core of a tile's result."""
        inner_rows, inner_columns = (
            slice(c.start - r.start, c.stop - r.start) for c, r in zip(piece.core, piece.read, strict=True)
        )
        aux = getattr(result, "aux", None)
        self.has_aux |= aux is not None
        for name, image in {None: _color(result), **(aux or {})}.items():
            if name not in self.layers:
                self.layers[name] = image.new_empty(*image.shape[:-2], *self.size)
            self.layers[name][..., piece.core[0], piece.core[1]] = image[..., inner_rows, inner_columns]
        self.carried.place(piece.core, piece.read, getattr(result, "state", None))
        self.done += _share(piece, self.size)

    def cut(self, height: int, width: int) -> Denoised:
        """Return the result without the rows and columns that were padded."""
        aux = {n: image[..., :height, :width] for n, image in self.layers.items() if n is not None}
        color = self.layers[None][..., :height, :width]
        return Denoised(color, self.carried.state, aux if self.has_aux else None)


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
    frames = first.shape[1] if getattr(denoiser, "frames", 0) else 1
    return first.shape[0] * frames, first.shape[-2], first.shape[-1]


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
    if image.ndim == 5:  # `F.pad` repeats borders of (B, C, H, W) only
        return _padded(name, image.flatten(0, 1), multiple).unflatten(0, image.shape[:2])
    return F.pad(image, (0, right, 0, bottom), mode="replicate")


def _color(result: Any) -> Tensor:
    color = getattr(result, "color", result)
    if not isinstance(color, torch.Tensor):
        raise TypeError(f"a denoiser returns a tensor or Denoised, got {type(result).__name__}")
    return color
