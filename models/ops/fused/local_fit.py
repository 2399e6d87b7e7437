"""The linear fits of a pixel, for `models.ops.fused.local_rows`.

The neighbours that some trial reaches are sorted by the smallest bandwidth that reaches them; those of a
trial are then the first ones, and the others cost nothing.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

import numpy as np
from numba import njit

from models.ops.fused.local import number, weigh
from models.ops.fused.products import SUMS, combined, products, solve
from models.ops.fused.strips import INNER

_TINY = 1e-200


@njit(**SUMS)
def _reached(w, count):
    """Return how many weights are above 0."""
    found = 0.0
    for n in range(np.uintp(count)):
        found += 1.0 if w[n] > 0.0 else 0.0
    return found


@njit(**SUMS)
def _applied(line, z, row, count, result):
    """Write sum l c of the colours and sum l^2 V, which stand in the rows from `row` on."""
    r0 = r1 = r2 = spread = 0.0
    a = np.uintp(row)
    b, c, d = a + np.uintp(1), a + np.uintp(2), a + np.uintp(3)
    for n in range(np.uintp(count)):
        own = line[0, n]
        r0, r1, r2 = r0 + own * z[a, n], r1 + own * z[b, n], r2 + own * z[c, n]
        spread += own * own * z[d, n]
    result[0], result[1], result[2], result[3] = r0, r1, r2, spread


@njit(**SUMS)
def _averaged(line, count):
    """Keep what is positive, with the sum 1."""
    total = 0.0
    for n in range(np.uintp(count)):
        total += line[0, n] if line[0, n] > 0.0 else 0.0
    total = max(total, _TINY)
    for n in range(np.uintp(count)):
        line[0, n] = line[0, n] / total if line[0, n] > 0.0 else 0.0


@njit(**INNER)
def fit(count, rank, h, s):
    """Fit the first neighbours and write colour and variance; returns whether there were two at least."""
    size = 1 + rank
    for n in range(np.uintp(count)):
        s.w[n] = s.base[n]
    weigh(s.packed, rank, 1 / (h * h), count, s.w)
    if _reached(s.w, count) < 2.0:
        return False
    products(s.packed, s.w, size, size, count, s.sums)
    for a in range(size):
        s.sums[a, a] += s.ridges[a - 1] if a else 0.0
        s.sums[a, size] = 0.0 if a else 1.0
    solve(s.sums, size, 1, s.solution)
    for a in range(size, size + 3):
        s.solution[0, a] = 0.0
    combined(s.packed, s.solution[0], size, count, s.line, 0)
    for n in range(np.uintp(count)):
        s.line[0, n] *= s.w[n]
    _applied(s.line, s.packed, size, count, s.result)
    if s.result[0] < 0.0 or s.result[1] < 0.0 or s.result[2] < 0.0:
        _averaged(s.line, count)
        _applied(s.line, s.packed, size, count, s.result)
    return True


@njit(**INNER)
def _sort(rank, shape, trials, s):
    """Divide coordinates by their bandwidths, and find which trials reach a neighbour: from which one on."""
    far, count = s.w, np.uintp(s.weight.shape[0])
    for n in range(count):
        far[n] = 0.0
    for a in range(rank):
        inverse, row = 1 / shape[a], np.uintp(1 + a)
        for n in range(count):
            s.z[row, n] *= inverse
        for n in range(count):
            square = s.z[row, n] * s.z[row, n]
            far[n] = square if square > far[n] else far[n]
    for n in range(count):
        s.kinds[n] = 0 if s.weight[n] > 0.0 else trials.shape[0]
    for k in range(trials.shape[0]):
        square = trials[k] * trials[k]
        for n in range(count):
            s.kinds[n] += 1 if far[n] > square else 0


@njit(**INNER)
def _pack(rank, last, s):
    """Put the neighbours that trials reach side by side, those of the smallest bandwidth first."""
    dimensions = s.near.shape[0] - 4
    s.ends.fill(0)
    for n in range(np.uintp(s.weight.shape[0])):
        if s.kinds[n] < last:
            s.ends[s.kinds[n] + 1] += 1
    for k in range(1, last):
        s.ends[k + 1] += s.ends[k]
    for n in range(np.uintp(s.weight.shape[0])):
        if s.kinds[n] < last:
            s.order[s.ends[s.kinds[n]]] = n
            s.ends[s.kinds[n]] += 1
    count, share = np.uintp(s.ends[last - 1]), 0.75**rank
    for i in range(count):
        s.packed[0, i] = 1.0
    for i in range(count):
        s.base[i] = s.weight[s.order[i]] * share
    for a in range(np.uintp(1), np.uintp(1 + rank)):
        for i in range(count):
            s.packed[a, i] = s.z[a, s.order[i]]
    for c in range(4):
        row, source = np.uintp(1 + rank + c), np.uintp(dimensions + c)
        for i in range(count):
            s.packed[row, i] = s.near[source, s.order[i]]


@njit(**INNER)
def prepare(numbers, rank, shape, trials, s):
    """Sort and pack the neighbours of a pixel whose coordinates are known."""
    _sort(rank, shape, trials, s)
    _pack(rank, trials.shape[0], s)
    for a in range(rank):
        s.ridges[a] = numbers.ridge / (shape[a] * shape[a])  # of slopes per bandwidth


@njit(**INNER)
def own_of(stack, y, x, window, s, result):
    """Write the pixel's colour and variance, or the mean colour of its window where it is not known."""
    first, middle = stack.shape[0] - 8, (y + window, x + window)
    for c in range(4):
        result[c] = stack[first + c, middle[0], middle[1]]
    if stack[first + 4, middle[0], middle[1]] > 0:
        return
    count, dimensions = number(s.known), s.near.shape[0] - 4
    for c in range(3):
        for n in range(s.known.shape[0]):
            result[c] += s.near[dimensions + c, n]
        result[c] /= count


@njit(**INNER)
def tried(local, y, x, rank, shape, s, own, bias, variance):
    """Fit a pixel with all trials."""
    prepare(local.numbers, rank, shape, local.trials, s)
    own_of(local.stack, y, x, local.numbers.window, s, own)
    for k in range(local.trials.shape[0]):
        if fit(s.ends[k], rank, local.trials[k], s):
            moved = s.result[0] - own[0] + (s.result[1] - own[1]) + (s.result[2] - own[2])
            bias[k], variance[k] = moved / 3, s.result[3]
        else:
            bias[k], variance[k] = 0.0, own[3]
