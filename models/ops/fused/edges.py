"""Edge-stopping means of `models.ops.atrous`, a piece of a row at a time.

Weights of a piece towards one tap are made in passes over a row of scratch, which stays in the first cache,
and added at once. The power of a cosine is made of squares, so that its exponent must be a power of 2.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.ops.fused.strips import INNER, OPTIONS, Array, Rows
from models.ops.fused.weights import exponential

_COLUMNS = 256
"""Of a piece: what is added to it fills 8 kB."""

_ROWS = 8
"""Rows that a thread does at a time."""


class Edges(NamedTuple):
    """What pixels show, and how different neighbours may be.

    Attributes:
        own: Unit normal, depth, slopes to the right and downwards (6, H, W).
        around: Normal and depth with `reach` pixels of 0 around, (4, H + 2 reach, W + 2 reach).
        reach: Pixels to the farthest tap.
        doublings: Power of 2 that is the exponent of cosines between normals.
        depth: sigma_z.
        flattest: Least change of depth that counts.
        steepest: Whether the steeper slope counts, not that in a tap's direction.
    """

    own: Array
    around: Array
    reach: int
    doublings: int
    depth: np.float32
    flattest: np.float32
    steepest: bool


@njit(**INNER)
def _changes(edges, y, left, down, right, change):
    """Write what the depth may change by towards a tap."""
    x, columns = np.uintp(left), np.uintp(change.shape[0])
    across, along = np.float32(right), np.float32(down)
    if edges.steepest:
        distance = np.float32((down * down + right * right) ** 0.5)
        for j in range(columns):
            one, other = abs(edges.own[4, y, x + j]), abs(edges.own[5, y, x + j])
            change[j] = (one if one > other else other) * distance
    else:
        for j in range(columns):
            change[j] = abs(edges.own[4, y, x + j] * across + edges.own[5, y, x + j] * along)


@njit(**INNER)
def _weights(edges, values, spread, y, left, tap, change, weight):
    """Write the weights of a piece of a row towards one tap."""
    down, right, kernel = tap
    x, columns = np.uintp(left), np.uintp(weight.shape[0])
    v, w = y + edges.reach + down, np.uintp(left + edges.reach + right)
    u, c = y + edges.reach, np.uintp(left + edges.reach)
    own, around = edges.own, edges.around
    zero, one = np.float32(0.0), np.float32(1.0)
    for j in range(columns):
        alike = own[0, y, x + j] * around[0, v, w + j] + own[1, y, x + j] * around[1, v, w + j]
        alike += own[2, y, x + j] * around[2, v, w + j]
        alike = alike if alike > zero else zero
        weight[j] = alike if alike < one else one
    for _ in range(edges.doublings):
        for j in range(columns):
            weight[j] *= weight[j]
    for j in range(columns):
        allowed = change[j] if change[j] > edges.flattest else edges.flattest
        apart = abs(own[3, y, x + j] - around[3, v, w + j]) / (edges.depth * allowed)
        apart += abs(values[0, u, c + j] - values[0, v, w + j]) / spread[y, x + j]
        weight[j] *= kernel * exponential(apart)


@njit(**INNER)
def _add(values, v, w, count, weight, totals):
    """Add weight, weighted values, and variances weighted with squared weights."""
    columns, first = np.uintp(weight.shape[0]), np.uintp(0)
    for j in range(columns):
        totals[first, j] += weight[j]
    for k in range(np.uintp(1), np.uintp(1 + count)):
        for j in range(columns):
            totals[k, j] += weight[j] * values[k, v, w + j]
    for j in range(columns):
        weight[j] *= weight[j]
    for k in range(np.uintp(1 + count), np.uintp(values.shape[0])):
        for j in range(columns):
            totals[k, j] += weight[j] * values[k, v, w + j]


@njit(**OPTIONS)
def _mean_rows(edges, values, count, spread, taps, kernels, rows, scratch, out):
    """Write the means of rows start … stop - 1."""
    totals, all_weights, all_changes = scratch
    width, pieces = out.shape[2], all_weights.shape[0]
    for y in range(rows[0], rows[1]):
        for left in range(0, width, pieces):
            size = min(pieces, width - left)
            weight, change = all_weights[:size], all_changes[:size]
            totals.fill(0.0)
            for n in range(taps.shape[0]):
                down, right = taps[n]
                if down == 0 and right == 0:
                    weight.fill(kernels[n])
                else:
                    _changes(edges, y, left, down, right, change)
                    _weights(edges, values, spread, y, left, (down, right, kernels[n]), change, weight)
                w = np.uintp(left + edges.reach + right)
                _add(values, y + edges.reach + down, w, count, weight, totals)
            for k in range(1, out.shape[0] + 1):
                for j in range(size):
                    norm = totals[0, j]
                    norm = norm * norm if k > count else norm
                    out[k - 1, y, left + j] = totals[k, j] / norm


def edge_means(
    edges: Edges,
    values: Array,
    count: int,
    spread: Array,
    taps: NDArray[np.int64],
    kernels: Array,
    threads: int,
) -> Array:
    """Return weighted means of values and of variances; see `models.ops.atrous.edge_stopping_means`.

    Args:
        edges: What pixels show.
        values: Luminance, `count` values and variances, padded like `edges.around`.
        count: Number of values.
        spread: (H, W).
        taps: Rows down and columns to the right, (K, 2).
        kernels: Kernel number of each tap.
        threads: How many rows are worked on at once.

    Returns:
        Means of the values, then of the variances, (values and variances, H, W).
    """
    height, width = spread.shape
    out = np.empty((values.shape[0] - 1, height, width), np.float32)

    def run(rows: Rows) -> None:
        scratch = (
            np.zeros((values.shape[0], _COLUMNS), np.float32),
            np.zeros(_COLUMNS, np.float32),
            np.zeros(_COLUMNS, np.float32),
        )
        _mean_rows(edges, values, count, spread, taps, kernels, rows, scratch, out)

    parts = [(top, min(top + _ROWS, height)) for top in range(0, height, _ROWS)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, parts))
    return out
