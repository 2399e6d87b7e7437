"""Local regression of rows of pixels: what `models.ops.fused.local` does for one, for all, in threads."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg"
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.ops.fused.eigen import eigenvectors
from models.ops.fused.local import (
    Doubles,
    Numbers,
    Scratch,
    axes_of,
    bandwidths,
    coordinates,
    cut,
    cut_light,
    scatter,
    scratch_of,
)
from models.ops.fused.local_fit import fit, own_of, prepare, tried
from models.ops.fused.strips import OPTIONS, Rows
from models.pace import tick

_LANES = 64
"""Pixels whose matrices are made diagonal together."""

_ROWS = 4
"""Rows that a thread does at a time."""


class Local(NamedTuple):
    """An image and how it is fitted.

    Attributes:
        stack: See `models.ops.fused.local`.
        noise: Summed variances of the features' windows, (H, W, features).
        groups: Channels of each feature.
        numbers: Of the method.
        trials: Bandwidths, ascending.
    """

    stack: Doubles
    noise: Doubles
    groups: NDArray[np.int64]
    numbers: Numbers
    trials: Doubles


@dataclass(frozen=True)
class Found:
    """What the trials found in some rows.

    Attributes:
        axes: Of the reduced spaces, in the order of the coordinates, (rows, W, D, D or up to three more).
        rank: How many there are, (rows, W).
        shape: Bandwidths along them, (rows, W, D).
        bias: Mean of the channels of result minus pixel, (trials, rows, W).
        variance: Of the results, (trials, rows, W).
    """

    axes: Doubles
    rank: NDArray[np.int64]
    shape: Doubles
    bias: Doubles
    variance: Doubles

    def after(self, before: Found | None) -> Found:
        """Return this behind what was found in the rows before."""
        if before is None or not len(before.rank):
            return self
        axes, rank, shape = (
            np.concatenate([getattr(found, name) for found in (before, self)])
            for name in ("axes", "rank", "shape")
        )
        return Found(axes, rank, shape, self.bias[:, :0], self.variance[:, :0])

    def from_row(self, row: int) -> Found:
        """Return a copy of what was found from a row on, without the trials."""
        axes, rank, shape = self.axes[row:].copy(), self.rank[row:].copy(), self.shape[row:].copy()
        return Found(axes, rank, shape, self.bias[:, :0], self.variance[:, :0])


@njit(**OPTIONS)
def _estimate(local, rows, s, eigen, own, found):
    """Reduce, measure and try rows start … stop - 1, which are the rows from `at` on of what is found."""
    start, stop, at = rows
    m, v, scales, limits, work = eigen
    axes, rank, shape, bias, variance = found
    width = local.noise.shape[1]
    for y in range(start, stop):
        i = at + y - start
        for left in range(0, width, m.shape[2]):
            lanes = min(m.shape[2], width - left)
            m.fill(0.0)
            for j in range(lanes):
                cut(local.stack, y, left + j, local.numbers.window, s)
                noise = local.noise[y, left + j]
                scatter(noise, local.groups, local.numbers, j, (m, scales, limits), s)
            eigenvectors(m, v, work)
            for j in range(lanes):
                x = left + j
                cut(local.stack, y, x, local.numbers.window, s)
                rank[i, x] = axes_of(m, v, scales, limits, j, axes[i, x])
                coordinates(axes[i, x], rank[i, x], s)
                cut_light(local.stack, y, x, local.numbers, s)
                bandwidths(rank[i, x], local.numbers, s, shape[i, x])
                tried(local, y, x, rank[i, x], shape[i, x], s, own, bias[:, i, x], variance[:, i, x])


@njit(**OPTIONS)
def _finish(local, rows, s, trial, found, h, out):
    """Fit rows start … stop - 1 with the bandwidth of each pixel."""
    start, stop, at = rows
    axes, rank, shape = found
    for y in range(start, stop):
        i = at + y - start
        for x in range(local.noise.shape[1]):
            cut(local.stack, y, x, local.numbers.window, s)
            cut_light(local.stack, y, x, local.numbers, s)
            coordinates(axes[i, x], rank[i, x], s)
            trial[0] = h[i, x]
            prepare(local.numbers, rank[i, x], shape[i, x], trial, s)
            if not fit(s.ends[0], rank[i, x], h[i, x], s):
                own_of(local.stack, y, x, local.numbers.window, s, s.result)
            for c in range(3):
                out[c, i, x] = s.result[c]


def _scratch(local: Local) -> tuple[Scratch, Any, Doubles]:
    """Return what a thread works with: for a pixel, for matrices of `_LANES` pixels, for its own value."""
    size = 2 + int(local.groups.sum())
    eigen = tuple(np.zeros(shape) for shape in ((size, size, _LANES),) * 2)
    eigen += tuple(np.zeros(shape) for shape in ((size, _LANES), (_LANES,), (3, _LANES)))
    return scratch_of(size, local.numbers.window, len(local.trials)), eigen, np.zeros(4)


def estimate(local: Local, rows: Rows, threads: int) -> Found:
    """Reduce, measure and try rows start … stop - 1."""
    start, stop = rows
    width, size, trials = local.noise.shape[1], 2 + int(local.groups.sum()), len(local.trials)
    count = stop - start
    found = Found(
        np.zeros((count, width, size, -(-size // 4) * 4)),
        np.zeros((count, width), np.int64),
        np.zeros((count, width, size)),
        np.zeros((trials, count, width)),
        np.zeros((trials, count, width)),
    )

    def run(part: Rows) -> None:
        scratch, eigen, own = _scratch(local)
        arrays = (found.axes, found.rank, found.shape, found.bias, found.variance)
        _estimate(local, (*part, part[0] - start), scratch, eigen, own, arrays)

    _in_threads(run, rows, threads, local.noise.shape[0])
    return found


def finish(local: Local, rows: Rows, found: Found, h: Doubles, threads: int) -> Doubles:
    """Return the colours (3, rows, W) of rows start … stop - 1, the first of what was found.

    Args:
        local: The image.
        rows: start and stop.
        found: From row start on.
        h: Shared bandwidths (rows, W).
        threads: How many rows are worked on at once.
    """
    start, stop = rows
    out = np.zeros((3, stop - start, local.noise.shape[1]))

    def run(part: Rows) -> None:
        scratch, trial = _scratch(local)[0], np.zeros(1)
        arrays = (found.axes, found.rank, found.shape)
        _finish(local, (*part, part[0] - start), scratch, trial, arrays, h, out)

    _in_threads(run, rows, threads, local.noise.shape[0])
    return out


def _in_threads(run: Callable[[Rows], None], rows: Rows, threads: int, height: int) -> None:
    parts = [(row, min(row + _ROWS, rows[1])) for row in range(*rows, _ROWS)]
    with ThreadPoolExecutor(threads) as pool:
        for part, _ in zip(parts, pool.map(run, parts), strict=True):
            tick((part[1] - part[0]) / height)
