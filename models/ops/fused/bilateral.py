"""The cross-bilateral filter of `models.ops.scaled_bilateral`.

A few neighbouring pixels are worked on for all offsets of the window, so that what they are and their sums
stay in registers and in the nearest cache. Where the distance in the image alone brings their weights to 0,
an offset is left out.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, var-annotated"
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from models.ops.fused.strips import INNER, OPTIONS, Array, Rows, in_threads
from models.ops.fused.vectors import (
    LANES,
    any_positive,
    below,
    difference,
    load,
    powers_of_two,
    product,
    product_added,
    quotient,
    repeated,
    smaller,
    store,
    total,
)

if TYPE_CHECKING:
    from models.ops.scaled_bilateral import BilateralRule

_CUT = 45.0
"""Smaller weights than exp(-45) = 3e-20 are taken as 0."""

_SERIES = (1.5403530e-4, 1.3333558e-3, 9.6181291e-3, 5.5504109e-2, 2.4022651e-1, 6.9314718e-1, 1.0)
"""Taylor series of 2**f, from its sixth power down."""

_FARTHEST = 1e30
"""As in `models.ops.scaled_bilateral`."""


@njit(**INNER)
def _exponentials(x):
    """Return exp(-x) for x >= 0 to 2e-7, as `models.ops.fused.weights.exponential`."""
    shift = repeated(np.float32(12582912.0))
    t = product(repeated(np.float32(-1.4426950408889634)), smaller(x, repeated(np.float32(80.0))))
    shifted = total(t, shift)
    f = difference(t, difference(shifted, shift))
    series = repeated(np.float32(_SERIES[0]))
    for n in range(1, len(_SERIES)):
        series = product_added(series, f, repeated(np.float32(_SERIES[n])))
    return below(x, repeated(np.float32(_CUT)), product(series, powers_of_two(shifted)))


@njit(**INNER)
def _distance(images, spread, own, other, channels, plane):
    """Return the distance of some channels from their neighbours."""
    found = repeated(np.float32(0.0))
    for c in range(channels[0], channels[1]):
        f = difference(load(images, other + c * plane), load(images, own + c * plane))
        found = product_added(product(f, f), load(spread, own + c * plane), found)
    return smaller(found, repeated(np.float32(_FARTHEST)))


@njit(**INNER)
def _color_distance(images, changes, own, other, plane, epsilon):
    """Return the distance of the colour, without its factor."""
    found = repeated(np.float32(0.0))
    for c in range(3):
        spread = total(load(images, own + (3 + c) * plane), load(images, other + (3 + c) * plane))
        u = difference(load(images, other + c * plane), load(images, own + c * plane))
        store(changes, c * LANES, u)
        found = total(found, quotient(product(u, u), total(epsilon, spread)))
    return smaller(found, repeated(np.float32(_FARTHEST)))


@njit(**INNER)
def _add(sums, at, values):
    store(sums, at * LANES, total(load(sums, at * LANES), values))


@njit(**INNER)
def _add_slopes(sums, weight, changes, d, count):
    """Add weights and weighted changes times each distance."""
    for k in range(count):
        weighted = product(weight, load(d, k * LANES))
        _add(sums, 4 + 4 * k, weighted)
        for c in range(3):
            _add(sums, 5 + 4 * k + c, product(weighted, load(changes, c * LANES)))


@njit(**INNER)
def _sum_windows(images, spread, scales, starts, numbers, place, rows, scratch):
    """Sum over the windows of some pixels; place: index of the first, size of a plane, columns, the least
    scale of the distance in the image; rows: of the windows, and their radius."""
    own, plane, across, least = place
    first, last, y, window = rows
    changes, d, sums = scratch
    factor, epsilon = repeated(numbers[0]), repeated(numbers[1])
    inside = (starts[-1]) * plane
    for z in range(first, last):
        for right in range(-window, window + 1):
            square = np.float32((z - y) * (z - y) + right * right)
            if least * square >= np.float32(_CUT):
                continue
            other = own + (z - y) * across + right
            exponent = product(factor, _color_distance(images, changes, own, other, plane, epsilon))
            place_distance = repeated(square)
            store(d, 0, place_distance)
            exponent = product_added(load(scales, own), place_distance, exponent)
            for k in range(1, starts.shape[0]):
                one = _distance(images, spread, own, other, (starts[k - 1], starts[k]), plane)
                store(d, k * LANES, one)
                exponent = product_added(load(scales, own + k * plane), one, exponent)
            weight = product(_exponentials(exponent), load(images, other + inside))
            if not any_positive(weight):
                continue
            _add(sums, 0, weight)
            for c in range(3):
                _add(sums, 1 + c, product(weight, load(changes, c * LANES)))
            if sums.shape[0] > 4:
                _add_slopes(sums, weight, changes, d, starts.shape[0])


@njit(**OPTIONS)
def _sum_rows(images, spread, scales, starts, numbers, rule, rows, scratch, out):
    """Write the sums of rows into out (4 or more, H, columns); rule: width of the image, radius."""
    height, across = images.shape[1:]
    width, window = rule
    plane = height * across
    sums = scratch[2]
    for y in range(rows[0], rows[1]):
        first, last = max(0, y - window), min(height, y + window + 1)
        for left in range(0, width, LANES):
            least = np.float32(np.inf)
            for x in range(left, min(left + LANES, width)):
                least = min(least, scales[0, y, window + x])
            sums[:] = np.float32(0.0)
            place = (y * across + window + left, plane, across, least)
            _sum_windows(images, spread, scales, starts, numbers, place, (first, last, y, window), scratch)
            for i in range(sums.shape[0]):
                index = (i * height + y) * out.shape[2] + left
                store(out, index, load(sums, i * LANES))


def filter_scaled(
    parts: Sequence[Array], scales: Array, rule: BilateralRule, slopes: bool, threads: int
) -> tuple[Array, Array | None]:
    """Filter an image; see `models.ops.scaled_bilateral`.

    Args:
        parts: Colour and variance (3, H, W), features and their spread (K, H, W).
        scales: (1 + groups, H, W).
        rule: How distances are made.
        slopes: Whether the derivative is wanted.
        threads: How many strips are worked on at once.

    Returns:
        (3, H, W), and (1 + groups, 3, H, W) where it is wanted.
    """
    color, variance, features, spread = parts
    height, width = color.shape[1:]
    inside = np.ones((1, height, width), np.float32)

    def padded(*images: Array) -> Array:
        far = rule.window + -width % LANES
        return np.pad(np.concatenate(images), ((0, 0), (0, 0), (rule.window, far)))

    # Spreads lie where features do.
    joined, inverse = (
        padded(color, variance, features, inside),
        padded(color, variance, np.reciprocal(spread)),
    )
    starts = 6 + np.cumsum([0, *rule.groups])
    numbers, size = np.array([rule.factor, rule.epsilon], np.float32), (width, rule.window)
    kinds = 4 + 4 * rule.distances * slopes
    sums = np.empty((kinds, height, width + -width % LANES), np.float32)
    own = padded(scales)

    def run(rows: Rows) -> None:
        scratch = tuple(np.zeros((n, LANES), np.float32) for n in (3, rule.distances, kinds))
        _sum_rows(joined, inverse, own, starts, numbers, size, rows, scratch, sums)

    for _ in in_threads(run, height, threads):
        pass
    sums = sums[..., :width]
    change = sums[1:4] / sums[0]
    if not slopes:
        return color + change, None
    each = sums[4:].reshape(rule.distances, 4, height, width)
    return color + change, (change * each[:, :1] - each[:, 1:]) / sums[0]
