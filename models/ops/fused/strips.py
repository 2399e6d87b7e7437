"""Tiles, strips of rows and threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.ops.nlm import PatchKernel
from models.pace import tick

Array = NDArray[np.float32]
Rows = tuple[int, int]

TILE = (8, 64)
"""Rows and columns: sums of products of a row of 64 pixels with 10 regressors fill 22 kB."""

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
}
"""For every kernel. Sums keep their order; NaN keeps its meaning."""

INNER: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""For kernels that only kernels call."""

MODES = {"own": 0, "least": 1, "mean": 2}
"""Numbers of `PatchKernel.channels`."""


@dataclass(frozen=True)
class Kernel:
    """A `PatchKernel` with one bandwidth, and the number of threads."""

    window: int
    patch: int
    bandwidth: float
    epsilon: float
    cap: float
    channels: str
    threads: int

    @classmethod
    def of(cls, kernel: PatchKernel, bandwidth: float, threads: int) -> Kernel:
        """Return the numbers of one bandwidth."""
        parts = (kernel.window, kernel.patch, bandwidth, kernel.epsilon, kernel.cap, kernel.channels)
        return cls(*parts, threads)

    def rule(self, size: tuple[int, int]) -> tuple[int, int, int, int, int, Array]:
        """Return what kernels need: height, width, window, patch, mode, and k^2, epsilon and the cap."""
        numbers = np.array([self.bandwidth**2, self.epsilon, self.cap], np.float32)
        return (*size, self.window, self.patch, MODES[self.channels], numbers)


def padded(image: Array, kernel: Kernel) -> Array:
    """Pad with zeros by the reach of the kernel, and up to whole tiles on the far sides."""
    pad = kernel.window + kernel.patch
    far = [(pad, -size % tile + pad) for size, tile in zip(image.shape[-2:], TILE, strict=True)]
    return np.pad(np.asarray(image, np.float32), [(0, 0)] * (image.ndim - 2) + far)


def tiles(rows: Rows, width: int, size: tuple[int, int]) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """Yield the first row and column and the size of tiles that cover rows start … stop - 1."""
    start, stop = rows
    for top in range(start, stop, size[0]):
        for left in range(0, width, size[1]):
            yield top, left, (min(size[0], stop - top), min(size[1], width - left))


def in_threads(run: Callable[[Rows], Any], height: int, threads: int) -> Iterator[tuple[Rows, Any]]:
    """Call `run` for strips of whole tiles and yield rows and result in order."""
    tiles = -(-height // TILE[0])
    pieces = min(tiles, 4 * threads) if threads > 1 else 1
    rows = list(pairwise([tiles * i // pieces * TILE[0] for i in range(pieces)] + [height]))
    if threads == 1:
        yield from _ticking(((r, run(r)) for r in rows), height)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from _ticking(zip(rows, pool.map(run, rows), strict=True), height)


def _ticking(strips: Iterable[tuple[Rows, Any]], height: int) -> Iterator[tuple[Rows, Any]]:
    for (start, stop), result in strips:
        tick((stop - start) / height)
        yield (start, stop), result
