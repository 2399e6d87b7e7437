"""Collaborative first-order regression.

Throughout, `joined` holds features, then colours, (T, K + 3, …) padded; a row of pixels has its place
(frame, row, column) in it. Regressors are 1, row, column, frame if there are several, features.

Rows of pixels are worked on in groups of `LANES`. Neighbours whose weights are 0 for a whole group are left
out; those that remain are gathered, `CHUNK` at a time, as vectors of regressors, of which 12 products at once
are summed in registers. Columns of the window come first: consecutive neighbours then lie in different rows,
and additions to the output do not wait for each other.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, var-annotated"
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from models.ops.fused.strips import INNER, OPTIONS, TILE, Array, Kernel, Rows, in_threads, padded
from models.ops.fused.vectors import (
    LANES,
    add_to_doubles,
    any_positive,
    difference,
    load,
    product,
    product_added,
    repeated,
    store,
    total,
)
from models.ops.fused.weights import scratch_of, tile_weights

CHUNK = 16
"""Neighbours that are gathered at once: with 10 regressors, 16 kB of them."""

_ROWS, _COLUMNS = 3, 4
"""Of a block of products whose sums are in registers."""


@njit(**INNER)
def _neighbours(weights, group, around, kept):
    """Write the offsets at which a group has weights above 0 into kept[1:], and their number into kept[0]."""
    row, left = group
    frames, side = around
    rows, columns = weights.shape[2:]
    count = 0
    for t in range(frames):
        for right in range(side):
            for down in range(side):
                index = (t * side + down) * side + right
                if any_positive(load(weights, (index * rows + row) * columns + left)):
                    count += 1
                    kept[count] = index
    kept[0] = count


@njit(**INNER)
def _regressors(joined, place, index, window, z, at):
    """Write the regressors and colours of a group's neighbour into z[at] (R + 3, LANES); z[at, 0] is 1."""
    centre, y, x = place
    frames, channels, height, width = joined.shape
    side = 2 * window + 1
    t, rest = divmod(index, side * side)
    down, right = divmod(rest, side)
    plane = height * width
    own = centre * channels * plane + y * width + x
    other = t * channels * plane + (y + down - window) * width + x + right - window
    into = at * z.shape[1] * LANES
    store(z, into + LANES, repeated(np.float32(down - window)))
    store(z, into + 2 * LANES, repeated(np.float32(right - window)))
    into += 3 * LANES
    if frames > 1:
        store(z, into, repeated(np.float32(t - centre)))
        into += LANES
    for _ in range(channels - 3):
        store(z, into, difference(load(joined, other), load(joined, own)))
        own += plane
        other += plane
        into += LANES
    for _ in range(3):
        store(z, into, load(joined, other))
        other += plane
        into += LANES


@njit(**INNER)
def _add_to(sums, index, values):
    for value in values:
        add_to_doubles(sums, index, value)
        index += LANES


@njit(**INNER)
def _add_block(z, w, count, corner, sums):
    """Add the weighted products of 3 regressors with 4 regressors or colours, summed over neighbours."""
    a, b = corner
    step, line = z.shape[1] * LANES, sums.shape[1] * LANES
    first = a * line + b * LANES
    none = repeated(np.float32(0.0))
    s00, s01, s02, s03 = none, none, none, none
    s10, s11, s12, s13 = none, none, none, none
    s20, s21, s22, s23 = none, none, none, none
    p, q = a * LANES, b * LANES
    for n in range(count):
        own = load(w, n * LANES)
        w0, w1 = product(own, load(z, p)), product(own, load(z, p + LANES))
        w2 = product(own, load(z, p + 2 * LANES))
        z0, z1, z2, z3 = load(z, q), load(z, q + LANES), load(z, q + 2 * LANES), load(z, q + 3 * LANES)
        s00, s01 = product_added(w0, z0, s00), product_added(w0, z1, s01)
        s02, s03 = product_added(w0, z2, s02), product_added(w0, z3, s03)
        s10, s11 = product_added(w1, z0, s10), product_added(w1, z1, s11)
        s12, s13 = product_added(w1, z2, s12), product_added(w1, z3, s13)
        s20, s21 = product_added(w2, z0, s20), product_added(w2, z1, s21)
        s22, s23 = product_added(w2, z2, s22), product_added(w2, z3, s23)
        p += step
        q += step
    # Few neighbours in float32, then float64: added one by one, 361 numbers lose as many digits as the ridge
    # leaves.
    _add_to(sums, first, (s00, s01, s02, s03))
    _add_to(sums, first + line, (s10, s11, s12, s13))
    _add_to(sums, first + 2 * line, (s20, s21, s22, s23))


@njit(**INNER)
def _fit_group(joined, place, weights, group, scratch, matrix):
    """Sum the products of all neighbours of a group of pixels; group: its row and column in the tile."""
    z, w, sums, kept = scratch
    row, left, window = group
    rows, columns = weights.shape[2:]
    size = matrix.shape[0]
    sums.fill(0.0)
    done = 0
    while done < kept[0]:
        count = min(CHUNK, kept[0] - done)
        for n in range(count):
            index = kept[1 + done + n]
            _regressors(joined, place, index, window, z, n)
            store(w, n * LANES, load(weights, (index * rows + row) * columns + left))
        for a in range(0, size, 3):
            for b in range(a, size + 3, 4):
                _add_block(z, w, count, (a, b), sums)
        done += count
    for a in range(size):
        for b in range(a, size + 3):
            for lane in range(LANES):
                matrix[a, b, left + lane] = sums[a, b, lane]


@njit(**INNER)
def _to_covariances(matrix, joined, place, solver, work):
    """Eliminate the constant and add the ridge; work[a, 0] is the ridge, the least value of a pivot."""
    ridge, noise = solver
    centre, y, x = place
    size, columns = work.shape[0], work.shape[2]
    known = size - (joined.shape[1] - 3)
    for j in range(columns):
        work[0, 0, j] = matrix[0, 0, j] if matrix[0, 0, j] > 0 else 1.0  # beyond the image
    for b in range(1, size + 3):
        for j in range(columns):
            work[0, b, j] = matrix[0, b, j] / work[0, 0, j]
    for a in range(1, size):
        for b in range(a, size + 3):
            for j in range(columns):
                work[a, b, j] = matrix[a, b, j] - matrix[0, a, j] * work[0, b, j]
        for j in range(columns):
            floor = noise * np.float64(joined[centre, a - known, y, x + j]) if a >= known else 0.0
            work[a, 0, j] = ridge * matrix[a, a, j] + work[0, 0, j] * (floor * floor + 1e-30)
            work[a, a, j] += work[a, 0, j]


@njit(**INNER)
def _solve(work, model):
    """Factorise and substitute for a row of pixels; model: coefficients (3, R, columns)."""
    size, columns = work.shape[0], work.shape[2]
    for a in range(1, size):
        for j in range(columns):
            work[a, 0, j] = 1.0 / max(work[a, a, j], work[a, 0, j])
        for r in range(a + 1, size):
            for b in range(r, size + 3):
                for j in range(columns):
                    work[r, b, j] -= work[a, r, j] * work[a, 0, j] * work[a, b, j]
    for c in range(size, size + 3):
        for a in range(size - 1, 0, -1):
            for b in range(a + 1, size):
                for j in range(columns):
                    work[a, c, j] -= work[a, b, j] * work[b, c, j]
            for j in range(columns):
                work[a, c, j] *= work[a, 0, j]
                work[0, c, j] -= work[0, a, j] * work[a, c, j]
                model[c - size, a, j] = work[a, c, j]
        for j in range(columns):
            model[c - size, 0, j] = work[0, c, j]


@njit(**INNER)
def _add(predicted, weights, index, group, own, out):
    """Add a group's weighted predictions of one neighbour, and the weights; own: the pixel's place in out."""
    row, left, window = group
    rows, columns = weights.shape[2:]
    side = 2 * window + 1
    t, rest = divmod(index, side * side)
    down, right = divmod(rest, side)
    width = out.shape[3]
    plane = out.shape[2] * width
    at = 4 * t * plane + own + (down - window) * width + right - window
    w = load(weights, (index * rows + row) * columns + left)
    for value in predicted:
        store(out, at, product_added(w, value, load(out, at)))
        at += plane
    store(out, at, total(w, load(out, at)))


@njit(**INNER)
def _predict_group(joined, place, weights, group, kept, z, model, own, out):
    """Add the weighted predictions of all neighbours of a group of pixels, four at a time."""
    left, window = group[1:]
    columns, size = weights.shape[3], model.shape[1]
    step, line = z.shape[1] * LANES, size * columns
    for done in range(0, kept[0], 4):
        last = kept[0] - done - 1
        for n in range(4):
            _regressors(joined, place, kept[1 + done + min(n, last)], window, z, n)
        m = left
        r0 = r1 = r2 = r3 = load(model, m)
        g0 = g1 = g2 = g3 = load(model, m + line)
        b0 = b1 = b2 = b3 = load(model, m + 2 * line)
        for k in range(1, size):
            m += columns
            q = k * LANES
            z0, z1 = load(z, q), load(z, q + step)
            z2, z3 = load(z, q + 2 * step), load(z, q + 3 * step)
            slope = load(model, m)
            r0, r1 = product_added(slope, z0, r0), product_added(slope, z1, r1)
            r2, r3 = product_added(slope, z2, r2), product_added(slope, z3, r3)
            slope = load(model, m + line)
            g0, g1 = product_added(slope, z0, g0), product_added(slope, z1, g1)
            g2, g3 = product_added(slope, z2, g2), product_added(slope, z3, g3)
            slope = load(model, m + 2 * line)
            b0, b1 = product_added(slope, z0, b0), product_added(slope, z1, b1)
            b2, b3 = product_added(slope, z2, b2), product_added(slope, z3, b3)
        _add((r0, g0, b0), weights, kept[1 + done], group, own, out)
        if last > 0:
            _add((r1, g1, b1), weights, kept[2 + done], group, own, out)
        if last > 1:
            _add((r2, g2, b2), weights, kept[3 + done], group, own, out)
        if last > 2:
            _add((r3, g3, b3), weights, kept[4 + done], group, own, out)


@njit(**INNER)
def _regress_tile(joined, corner, weights, rule, scratch, out):
    """Fit and predict the windows of a tile; corner: frame, row and column, and the strip's first row."""
    gathering, matrix, work, model = scratch
    z, _, _, kept = gathering
    centre, top, left, start, stop = corner
    window, pad = rule[2], rule[2] + rule[3]
    solver = (rule[5][3], rule[5][4])
    columns, around = weights.shape[3], (joined.shape[0], 2 * window + 1)
    for i in range(min(weights.shape[2], stop - top)):
        place = (centre, top + i + pad, left + pad)
        for j in range(0, columns, LANES):
            _neighbours(weights, (i, j), around, kept)
            there = (centre, top + i + pad, left + pad + j)
            _fit_group(joined, there, weights, (i, j, window), gathering, matrix)
        _to_covariances(matrix, joined, place, solver, work)
        _solve(work, model)
        own = (top - start + i + window) * out.shape[3] + left + window
        for j in range(0, columns, LANES):
            _neighbours(weights, (i, j), around, kept)
            there = (centre, top + i + pad, left + pad + j)
            _predict_group(joined, there, weights, (i, j, window), kept, z, model, own + j, out)


@njit(**OPTIONS)
def _regress_rows(joined, source, task, rule, weights, scratch, out):
    """Fit and predict the windows around a strip; out (T, 4, rows + 2 window, padded width)."""
    centre, start, stop = task
    rows, columns = weights.shape[2:]
    side = 2 * rule[2] + 1
    weighing, solving = scratch
    for top in range(start, stop, rows):
        for left in range(0, rule[1], columns):
            for index in range(weights.shape[0]):
                t, rest = divmod(index, side * side)
                down, right = divmod(rest, side)
                where = (centre, t, top, left, down - rule[2], right - rule[2])
                tile_weights(source, where, rule, weighing, weights, index)
            _regress_tile(joined, (centre, top, left, start, stop), weights, rule, solving, out)


def _aligned(*shape: int) -> Array:
    """Return zeros that start where a vector never spans two lines of the cache."""
    spare = 64 // 4
    memory = np.zeros(math.prod(shape) + spare, np.float32)
    first = -(memory.ctypes.data // 4) % spare
    return memory[first : first + math.prod(shape)].reshape(shape)


def _scratch_of(regressors: int, offsets: int) -> Any:
    """Return what a thread works with.

    That is gathered regressors, their weights, sums and kept offsets of a group; sums, covariances and
    coefficients of a row. What lies beyond the regressors stays 0: blocks of products reach over the end.
    """
    z = _aligned(CHUNK, regressors + 6, LANES)
    z[:, 0] = 1.0
    sums = np.zeros((regressors + 2, regressors + 6, LANES), np.float64)
    group = (z, _aligned(CHUNK, LANES), sums, np.zeros(1 + offsets, np.int64))
    columns = TILE[1]
    work = np.zeros((regressors, regressors + 3, columns), np.float64)
    return group, np.zeros_like(work), work, _aligned(3, regressors, columns)


def regress(
    joined: Array, guide: Array, variance: Array, kernel: Kernel, centre: int, solver: tuple[float, float]
) -> Array:
    """Fit and predict the windows around one frame; see `models.ops.regression`.

    Args:
        joined: Features, then colours, (T, K + 3, H, W).
        guide: (T, C, H, W).
        variance: Of the guide, scaled.
        kernel: How patches are compared.
        centre: Index of the frame.
        solver: Ridge and noise level.

    Returns:
        Weighted predictions and weights of every frame (T, 4, H, W).
    """
    frames, channels, height, width = joined.shape
    window = kernel.window
    regressors, offsets = channels + (1 if frames > 1 else 0), frames * (2 * window + 1) ** 2
    joined, source = padded(joined, kernel), (padded(guide, kernel), padded(variance, kernel))
    *rule, numbers = kernel.rule((height, width))
    total = np.zeros((frames, 4, height + 2 * window, width + 2 * window), np.float32)
    with_solver = (*rule, np.append(numbers, np.array(solver, np.float32)))

    def run(rows: Rows) -> Array:
        out = np.zeros((frames, 4, rows[1] - rows[0] + 2 * window, joined.shape[-1]), np.float32)
        weights = _aligned(offsets, 1, *TILE)
        scratch = (scratch_of(kernel.patch, TILE), _scratch_of(regressors, offsets))
        _regress_rows(joined, source, (centre, *rows), with_solver, weights, scratch, out)
        return out

    for (start, stop), out in in_threads(run, height, kernel.threads):
        total[:, :, start : stop + 2 * window] += out[..., : width + 2 * window]
    return total[:, :, window : window + height, window : window + width]
