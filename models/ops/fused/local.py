"""The reduced space of a pixel and its bandwidths: `models.ops.local_regression`, compiled.

A pixel at a time, with its neighbours side by side: sums over them are made by vector instructions. Only the
directions that are kept are computed with.

Throughout, `stack` holds features, colour (3), variance, `known`, standard deviation, grey, and what a
neighbour weighs beside its kernel, (F + 8, H, W) with `window` pixels of 0 around. `near` holds position and
features relative to the pixel, then colour and variance of its neighbours, (D + 4, N). `z` holds 1,
regressors and colour, likewise.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.ops.fused.products import SUMS, combined, products, solve
from models.ops.fused.strips import INNER

Doubles = NDArray[np.float64]


class Numbers(NamedTuple):
    """The numbers of `models.ops.local_regression.LocalRule` that are needed here, named as there."""

    window: int
    least_scale: float
    noise_factor: float
    least_singular: float
    least_curvature: float
    quadratic_ridge: float
    ridge: float
    color_factor: float
    color_floor: float


class Scratch(NamedTuple):
    """What a pixel is worked on with; N neighbours, D dimensions.

    Attributes:
        near: See above.
        known: 1 for neighbours that take part, (N,).
        weight: Of those that colour lets pass, beside the kernel, (N,).
        z: See above, (2 D + 8, N).
        kinds: The smallest trial that reaches a neighbour, (N,).
        order: The neighbours, those of the smallest trial first, (N,).
        ends: Where each trial's end, (trials + 1,).
        packed: 1, coordinates, colour and variance in that order, (D + 5, N).
        base: Weights in that order, (N,).
        w: Weights of a fit, (N,).
        line: What is multiplied with colours, (1, N).
        sums: Sums of products, (2 D + 8, 2 D + 8).
        solution: Of the equations, (3, 2 D + 8).
        means: (D,).
        ridges: (D,).
        result: Colour and variance.
    """

    near: Doubles
    known: Doubles
    weight: Doubles
    z: Doubles
    kinds: NDArray[np.int64]
    order: NDArray[np.uint64]
    ends: NDArray[np.int64]
    packed: Doubles
    base: Doubles
    w: Doubles
    line: Doubles
    sums: Doubles
    solution: Doubles
    means: Doubles
    ridges: Doubles
    result: Doubles


def scratch_of(dimensions: int, window: int, trials: int) -> Scratch:
    """Return what a thread works with."""
    count, wide = (2 * window + 1) ** 2, 2 * dimensions + 8

    def zeros(*shape: int, kind: Any = np.float64) -> Any:
        return np.zeros(shape, kind)

    return Scratch(
        zeros(dimensions + 4, count),
        zeros(count),
        zeros(count),
        zeros(wide, count),
        zeros(count, kind=np.int64),
        zeros(count, kind=np.uint64),
        zeros(trials + 1, kind=np.int64),
        zeros(dimensions + 5, count),
        zeros(count),
        zeros(count),
        zeros(1, count),
        zeros(wide, wide),
        zeros(3, wide),
        zeros(dimensions),
        zeros(dimensions),
        zeros(4),
    )


@njit(**SUMS)
def _total(values, row):
    found = 0.0
    for n in range(np.uintp(values.shape[1])):
        found += values[row, n]
    return found


@njit(**SUMS)
def number(known):
    """Return how many neighbours take part, at least 1."""
    found = 0.0
    for n in range(np.uintp(known.shape[0])):
        found += known[n]
    return max(found, 1.0)


@njit(**INNER)
def cut(stack, y, x, window, s):
    """Cut position and features relative to a pixel; 0 for neighbours that are not known."""
    side, dimensions = np.uintp(2 * window + 1), s.near.shape[0] - 4
    mask, middle = np.uintp(dimensions + 2), np.uintp(window)
    top, left = np.uintp(y), np.uintp(x)
    for i in range(side):
        at, v, down = i * side, top + i, np.float64(i) - window
        for j in range(side):
            s.known[at + j] = stack[mask, v, left + j]
        for j in range(side):
            s.near[0, at + j] = (np.float64(j) - window) * stack[mask, v, left + j]
        for j in range(side):
            s.near[1, at + j] = down * stack[mask, v, left + j]
    for c in range(np.uintp(dimensions - 2)):
        own, row = stack[c, top + middle, left + middle], c + np.uintp(2)
        for i in range(side):
            at, v = i * side, top + i
            for j in range(side):
                s.near[row, at + j] = (stack[c, v, left + j] - own) * stack[mask, v, left + j]


@njit(**INNER)
def cut_light(stack, y, x, numbers, s):
    """Cut colours and variances, and what neighbours that colour lets pass weigh beside their kernel."""
    side, dimensions = np.uintp(2 * numbers.window + 1), s.near.shape[0] - 4
    first = np.uintp(dimensions - 2)
    spread, grey, trust = first + np.uintp(5), first + np.uintp(6), first + np.uintp(7)
    top, left, middle = np.uintp(y), np.uintp(x), np.uintp(numbers.window)
    own, deviation = stack[grey, top + middle, left + middle], stack[spread, top + middle, left + middle]
    if stack[first + np.uintp(4), top + middle, left + middle] <= 0.0:
        deviation = np.inf  # it is not known: all pass
    for c in range(np.uintp(4)):
        row = np.uintp(dimensions) + c
        for i in range(side):
            for j in range(side):
                s.near[row, i * side + j] = stack[first + c, top + i, left + j]
    for i in range(side):
        at, v = i * side, top + i
        for j in range(side):
            limit = numbers.color_factor * (stack[spread, v, left + j] + deviation) + numbers.color_floor
            passes = abs(stack[grey, v, left + j] - own) <= limit
            s.weight[at + j] = stack[trust, v, left + j] if passes else 0.0


@njit(**{**SUMS, "fastmath": {"contract", "nsz", "reassoc", "nnan"}})
def _farthest(s, first, channels):
    """Return the largest length of a feature's deviations from their mean."""
    distance, count = s.w, np.uintp(s.known.shape[0])
    for n in range(count):
        distance[n] = 0.0
    for c in range(np.uintp(first), np.uintp(first + channels)):
        mean = s.means[c]
        for n in range(count):
            distance[n] += (s.near[c, n] - mean) * (s.near[c, n] - mean)
    found = 0.0
    for n in range(count):
        far = distance[n] * s.known[n]
        found = far if far > found else found
    return math.sqrt(found)


@njit(**INNER)
def scatter(noise, groups, numbers, lane, matrices, s):
    """Write the scatter of the scaled features of a pixel, their scales, and what counts as noise."""
    m, scales, limits = matrices
    size, count = s.near.shape[0] - 4, number(s.known)
    products(s.near, s.known, size, size, s.known.shape[0], s.sums)
    for a in range(size):
        s.means[a] = _total(s.near, a) / count
    scales[0, lane] = scales[1, lane] = numbers.window
    first, error = 2, 0.0
    for g in range(groups.shape[0]):
        far = max(_farthest(s, first, groups[g]), numbers.least_scale)
        error += noise[g] / (far * far)
        for _ in range(groups[g]):
            scales[first, lane] = far
            first += 1
    limits[lane] = numbers.least_singular + numbers.noise_factor * 2 * math.sqrt(error / size)
    for a in range(size):
        for b in range(a, size):
            # Those of positions are whole numbers, so that the axes of constant features are right and down.
            deviations = s.sums[a, b] - count * s.means[a] * s.means[b]
            m[a, b, lane] = deviations / (scales[a, lane] * scales[b, lane])


@njit(**INNER)
def axes_of(m, v, scales, limits, lane, axes):
    """Write the axes of the directions that stand out of noise, at least two; returns how many."""
    size, rank = m.shape[0], 0
    for i in range(size):
        value, larger = m[i, i, lane], 0
        for k in range(size):
            other = m[k, k, lane]
            if other > value or (other == value and k > i):
                larger += 1
        if larger < 2 or math.sqrt(max(value, 0.0)) > limits[lane]:
            for d in range(size):
                axes[rank, d] = v[d, i, lane] / scales[d, lane]
            rank += 1
    return rank


@njit(**INNER)
def coordinates(axes, rank, s):
    """Write 1 and the coordinates of all neighbours into z."""
    count = s.near.shape[1]
    for n in range(np.uintp(count)):
        s.z[0, n] = 1.0
    for a in range(rank):
        combined(s.near, axes[a], s.near.shape[0] - 4, count, s.z, 1 + a)


@njit(**INNER)
def weigh(z, rank, square, count, w):
    """Multiply weights by the kernel of coordinates whose bandwidth is the root of 1 / square."""
    for a in range(np.uintp(1), np.uintp(1 + rank)):
        for n in range(np.uintp(count)):
            part = 1.0 - z[a, n] * z[a, n] * square
            w[n] *= part if part > 0.0 else 0.0


@njit(**INNER)
def bandwidths(rank, numbers, s, shape):
    """Write the bandwidth along each coordinate, from the curvature of the colour."""
    count, size, dimensions = s.near.shape[1], 1 + 2 * rank, s.near.shape[0] - 4
    for n in range(np.uintp(count)):
        s.w[n] = s.known[n]
    weigh(s.z, rank, 1.0, count, s.w)
    for a in range(1, 1 + rank):
        for n in range(np.uintp(count)):
            s.z[rank + a, n] = s.z[a, n] * s.z[a, n]
    for c in range(3):
        for n in range(np.uintp(count)):
            s.z[size + c, n] = s.near[dimensions + c, n]
    products(s.z, s.w, size, size + 3, count, s.sums)
    share = 0.75**rank
    for a in range(size):
        for b in range(a, size + 3):
            s.sums[a, b] *= share
        s.sums[a, a] += numbers.quadratic_ridge if a else 0.0
    if s.sums[0, 0] <= 0.0:  # no neighbour at all
        s.sums[0, 0] = 1.0
    solve(s.sums, size, 3, s.solution)
    for a in range(rank):
        row = 1 + rank + a
        bent = 2 * (abs(s.solution[0, row]) + abs(s.solution[1, row]) + abs(s.solution[2, row])) / 3
        shape[a] = 1 / math.sqrt(bent + numbers.least_curvature)
