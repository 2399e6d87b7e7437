"""What pixels contribute to the distances of their histograms, for `models.ops.histogram_distance`."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit

from models.ops.fused.strips import OPTIONS, Array

_TILE = 64
"""Columns: two rows of 60 bins and of their shares fill 61 kB."""


@njit(**OPTIONS)
def _add_terms(histogram, share, number, place, out):
    """Write the sum over bins, and how many count; place: first row and column, offset, the least count."""
    top, left, down, right, least = place
    least, none, one = np.float32(least), np.float32(0.0), np.float32(1.0)
    for start in range(0, out.shape[2], _TILE):
        wide, s = np.uintp(min(_TILE, out.shape[2] - start)), np.uintp(start)
        x, w = np.uintp(left + start), np.uintp(left + start + right)
        for i in range(out.shape[1]):
            y, v = top + i, top + i + down
            for j in range(wide):
                out[0, i, s + j] = none
                out[1, i, s + j] = none
            for c in range(histogram.shape[0]):
                for j in range(wide):
                    both = histogram[c, y, x + j] + histogram[c, v, w + j]
                    difference = share[c, y, x + j] - share[c, v, w + j]
                    term = difference * difference / both
                    out[0, i, s + j] += term if both > least else none
                    out[1, i, s + j] += one if both > least else none
            for j in range(wide):
                product = number[y, x + j] * number[v, w + j]
                out[0, i, s + j] *= product
                out[1, i, s + j] *= one if product > none else none


def pixel_terms(
    images: tuple[Array, Array, Array],
    parts: Sequence[tuple[tuple[int, int, int, int], tuple[int, int]]],
    least: float,
    threads: int,
) -> list[Array]:
    """Return the sum over bins and the number of bins that count, (2, h, w) for every part.

    Args:
        images: Histograms and their shares of the samples (C, H, W), and the samples (H, W).
        parts: First row and column, offset down and to the right, rows and columns.
        least: Bins with no more than this in both histograms together do not count.
        threads: How many parts are worked on at once.
    """

    def run(part: tuple[tuple[int, int, int, int], tuple[int, int]]) -> Array:
        place, size = part
        out = np.empty((2, *size), np.float32)
        _add_terms(*images, (*place, least), out)
        return out

    if threads == 1:
        return [run(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, parts))
