"""The cross-bilateral filter of `models.ops.scaled_bilateral`.

A piece of a row is worked on for all offsets of the window, so that what its pixels are and all their sums
stay in the nearest cache. Where the distance in the image alone brings the weights of all its pixels to 0, an
offset is left out.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from models.ops.fused.strips import INNER, OPTIONS, Array, Rows, in_threads
from models.ops.fused.weights import exponential

if TYPE_CHECKING:
    from models.ops.scaled_bilateral import BilateralRule

PIECE = 64
"""Columns."""

_CUT = 45.0
"""Exponents from here on are weights of 0, as in `exponential`."""

_FARTHEST = 1e30


@njit(**INNER)
def _distances(images, spread, starts, place, numbers, scratch):
    """Write the exponent's part of the colour, and the distances of features, of a piece of a row.

    place: row and first column of the pixels in the image, the same of the neighbours, and their number.
    """
    color, variance, features = images
    exponent, d = scratch[0], scratch[1]
    y, x, z, w, columns = place
    factor, epsilon = numbers[0], numbers[1]
    for j in range(columns):
        exponent[j] = np.float32(0.0)
    for c in range(3):
        for j in range(columns):
            u = color[c, y, x + j] - color[c, z, w + j]
            exponent[j] += u * u / (epsilon + (variance[c, y, x + j] + variance[c, z, w + j]))
    for j in range(columns):
        exponent[j] = factor * min(exponent[j], np.float32(_FARTHEST))
    for k in range(starts.shape[0] - 1):
        for j in range(columns):
            d[k + 1, j] = np.float32(0.0)
        for c in range(starts[k], starts[k + 1]):
            for j in range(columns):
                f = features[c, y, x + j] - features[c, z, w + j]
                d[k + 1, j] += f * f * spread[c, y, x + j]
        for j in range(columns):
            d[k + 1, j] = min(d[k + 1, j], np.float32(_FARTHEST))


@njit(**INNER)
def _add(color, scales, place, square, scratch, sums):
    """Add the neighbours of a piece to its sums; square: of their distance in the image."""
    exponent, d, weight, change = scratch
    y, x, z, w, columns, first = place
    for j in range(columns):
        d[0, j] = square
    for k in range(scales.shape[0]):
        for j in range(columns):
            exponent[j] += scales[k, y, x + j] * d[k, j]
    for j in range(columns):
        weight[j] = exponential(exponent[j])
        sums[0, first + j] += weight[j]
    for c in range(3):
        for j in range(columns):
            change[c, j] = weight[j] * (color[c, z, w + j] - color[c, y, x + j])
            sums[c + 1, first + j] += change[c, j]
    if sums.shape[0] == 4:
        return
    for k in range(scales.shape[0]):
        at = 4 + 4 * k
        for j in range(columns):
            sums[at, first + j] += weight[j] * d[k, j]
        for c in range(3):
            for j in range(columns):
                sums[at + 1 + c, first + j] += change[c, j] * d[k, j]


@njit(**OPTIONS)
def _sum_row(images, spread, scales, starts, numbers, place, scratch, sums):
    """Sum over the windows of a piece of a row; place: row, first column, columns, radius of the window."""
    color = images[0]
    height, width = color.shape[1:]
    y, left, columns, window = place
    least = np.float32(np.inf)
    for j in range(columns):
        least = min(least, scales[0, y, left + j])
    for z in range(max(0, y - window), min(height, y + window + 1)):
        for right in range(-window, window + 1):
            square = np.float32((z - y) * (z - y) + right * right)
            low = max(left, -right)
            high = min(left + columns, width - right)
            if high <= low or least * square >= np.float32(_CUT):
                continue
            row, x, w, n = np.uintp(y), np.uintp(low), np.uintp(low + right), np.uintp(high - low)
            other, first = np.uintp(z), np.uintp(low - left)
            _distances(images, spread, starts, (row, x, other, w, n), numbers, scratch)
            _add(color, scales, (row, x, other, w, n, first), square, scratch, sums)


def filter_scaled(
    parts: Sequence[Array], scales: Array, rule: BilateralRule, slopes: bool, threads: int
) -> tuple[Array, Array]:
    """Filter an image; see `models.ops.scaled_bilateral`.

    Args:
        parts: Colour and variance (3, H, W), features and their spread (K, H, W).
        scales: (1 + groups, H, W).
        rule: How distances are made.
        slopes: Whether the derivative is wanted.
        threads: How many strips are worked on at once.

    Returns:
        (3, H, W) and (1 + groups, 3, H, W), the latter without rows where it is not wanted.
    """
    color, variance, features, spread = (np.ascontiguousarray(part) for part in parts)
    scales, images = np.ascontiguousarray(scales), (color, variance, features)
    inverse = np.ascontiguousarray(1 / spread)
    height, width = color.shape[1:]
    starts, numbers = np.cumsum([0, *rule.groups]), np.array([rule.factor, rule.epsilon], np.float32)
    count = rule.distances if slopes else 0
    out, slope = np.empty_like(color), np.empty((rule.distances, 3, height, width * slopes), np.float32)

    def run(rows: Rows) -> None:
        scratch = tuple(np.zeros(n, np.float32) for n in (PIECE, (rule.distances, PIECE), PIECE, (3, PIECE)))
        for y in range(*rows):
            for left in range(0, width, PIECE):
                columns = min(PIECE, width - left)
                sums = np.zeros((4 + 4 * count, columns), np.float32)
                _sum_row(
                    images, inverse, scales, starts, numbers, (y, left, columns, rule.window), scratch, sums
                )
                piece = slice(left, left + columns)
                change = sums[1:4] / sums[0]
                out[:, y, piece] = color[:, y, piece] + change
                if slopes:
                    each = sums[4:].reshape(count, 4, columns)
                    slope[:, :, y, piece] = (change * each[:, :1] - each[:, 1:]) / sums[0]

    for _ in in_threads(run, height, threads):
        pass
    return out, slope
