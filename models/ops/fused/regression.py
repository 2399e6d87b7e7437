"""Collaborative first-order regression.

Throughout, `joined` holds features, then colours, (T, K + 3, …) padded; a row of pixels has its place
(frame, row, column) in it. Regressors are 1, row, column, frame if there are several, features.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

import numpy as np
from numba import njit

from models.ops.fused.strips import OPTIONS, TILE, Array, Kernel, Rows, in_threads, padded
from models.ops.fused.weights import scratch_of, tile_weights


@njit(**OPTIONS)
def _any(weights, index, row):
    for j in range(weights.shape[3]):  # noqa: SIM110 - ends at the first pixel in most places
        if weights[index, 0, row, j] > 0:
            return True
    return False


@njit(**OPTIONS)
def _offset(index, window):
    """Return frame, rows and columns of an offset."""
    side = 2 * window + 1
    t, rest = divmod(index, side * side)
    down, right = divmod(rest, side)
    return t, down - window, right - window


@njit(**OPTIONS)
def _regressors(joined, place, offset, z, at):
    """Write regressors and colours of a row of neighbours into z[at], (R + 3, columns); z[at, 0] is 1."""
    centre, y, left = place
    t, down, right = offset
    x, across, there = np.uintp(left), np.uintp(left + right), y + down
    known = 4 if joined.shape[0] > 1 else 3
    features, columns = joined.shape[1] - 3, z.shape[2]
    for j in range(columns):
        z[at, 1, j] = np.float32(down)
        z[at, 2, j] = np.float32(right)
    if known == 4:
        for j in range(columns):
            z[at, 3, j] = np.float32(t - centre)
    for k in range(features):
        for j in range(np.uintp(columns)):
            z[at, known + k, j] = joined[t, k, there, across + j] - joined[centre, k, y, x + j]
    for k in range(features, features + 3):
        for j in range(np.uintp(columns)):
            z[at, known + k, j] = joined[t, k, there, across + j]


@njit(**OPTIONS)
def _add_products(w, z, wz, matrix):
    """Add the products of four neighbours' weighted regressors with all later ones and the colours.

    Four at once, so that each sum is read and written a quarter as often.
    """
    columns = w.shape[1]
    for a in range(matrix.shape[0]):
        for n in range(4):
            for j in range(columns):
                wz[n, j] = w[n, j] * z[n, a, j]
        for b in range(a, matrix.shape[1]):
            for j in range(columns):
                first = wz[0, j] * z[0, b, j] + wz[1, j] * z[1, b, j]
                matrix[a, b, j] += first + (wz[2, j] * z[2, b, j] + wz[3, j] * z[3, b, j])


@njit(**OPTIONS)
def _fit_row(joined, place, weights, row_window, scratch, matrix):
    """Sum the products of all window offsets for a row of pixels."""
    z, wz, w = scratch
    row, window = row_window
    matrix.fill(np.float32(0.0))
    count, columns = 0, w.shape[1]
    for index in range(weights.shape[0]):
        if _any(weights, index, row):
            for j in range(columns):
                w[count, j] = weights[index, 0, row, j]
            _regressors(joined, place, _offset(index, window), z, count)
            count += 1
        if count == 4 or (count > 0 and index == weights.shape[0] - 1):
            for n in range(count, 4):
                for j in range(columns):
                    w[n, j] = np.float32(0.0)
            _add_products(w, z, wz, matrix)
            count = 0


@njit(**OPTIONS)
def _to_covariances(matrix, joined, place, solver, work):
    """Eliminate the constant and add the ridge; work[a, 0] is the ridge, the least value of a pivot."""
    ridge, noise = solver
    centre, y, x = place
    size, columns = matrix.shape[0], matrix.shape[2]
    known = size - (joined.shape[1] - 3)
    for j in range(columns):
        work[0, 0, j] = matrix[0, 0, j] if matrix[0, 0, j] > 0 else 1.0  # beyond the image
    for b in range(1, size + 3):
        for j in range(columns):
            work[0, b, j] = matrix[0, b, j] / work[0, 0, j]
    for a in range(1, size):
        for b in range(a, size + 3):
            for j in range(columns):
                work[a, b, j] = matrix[a, b, j] - np.float64(matrix[0, a, j]) * work[0, b, j]
        for j in range(columns):
            floor = noise * np.float64(joined[centre, a - known, y, x + j]) if a >= known else 0.0
            work[a, 0, j] = ridge * matrix[a, a, j] + work[0, 0, j] * (floor * floor + 1e-30)
            work[a, a, j] += work[a, 0, j]


@njit(**OPTIONS)
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


@njit(**OPTIONS)
def _predict(weights, index_row, z, model, out, place):
    """Add weighted predictions of a row of neighbours to out (T, 4, …); model: with scratch (columns)."""
    b, predicted = model
    index, row = index_row
    t, y, left = place
    x = np.uintp(left)
    regressors, columns = b.shape[1], b.shape[2]
    for c in range(3):
        for j in range(columns):
            predicted[j] = b[c, 0, j] + b[c, 1, j] * z[0, 1, j] + b[c, 2, j] * z[0, 2, j]
        k = 3
        while k + 3 < regressors:
            for j in range(columns):
                first = b[c, k, j] * z[0, k, j] + b[c, k + 1, j] * z[0, k + 1, j]
                second = b[c, k + 2, j] * z[0, k + 2, j] + b[c, k + 3, j] * z[0, k + 3, j]
                predicted[j] += first + second
            k += 4
        while k < regressors:
            for j in range(columns):
                predicted[j] += b[c, k, j] * z[0, k, j]
            k += 1
        for j in range(np.uintp(columns)):
            out[t, c, y, x + j] += weights[index, 0, row, j] * predicted[j]
    for j in range(np.uintp(columns)):
        out[t, 3, y, x + j] += weights[index, 0, row, j]


@njit(**OPTIONS)
def _regress_tile(joined, corner, weights, rule, scratch, out):
    """Fit and predict the windows of a tile; corner: frame, row and column, and the strip's first row."""
    fit, matrix, work, model = scratch
    centre, top, left, start, stop = corner
    window, pad = rule[2], rule[2] + rule[3]
    solver = (rule[5][3], rule[5][4])
    for i in range(min(weights.shape[2], stop - top)):
        place = (centre, top + i + pad, left + pad)
        _fit_row(joined, place, weights, (i, window), fit, matrix)
        _to_covariances(matrix, joined, place, solver, work)
        _solve(work, model[0])
        for index in range(weights.shape[0]):
            if _any(weights, index, i):
                t, down, right = _offset(index, window)
                _regressors(joined, place, (t, down, right), fit[0], 0)
                there = (t, top - start + i + window + down, left + window + right)
                _predict(weights, (index, i), fit[0], model, out, there)


@njit(**OPTIONS)
def _regress_rows(joined, source, task, rule, tile, out):
    """Fit and predict the windows around a strip; out (T, 4, rows + 2 window, padded width)."""
    centre, start, stop = task
    rows, columns = tile
    side, frames = 2 * rule[2] + 1, joined.shape[0]
    regressors = joined.shape[1] - 3 + (4 if frames > 1 else 3)
    weights = np.zeros((frames * side * side, 1, rows, columns), np.float32)
    four = (4, columns)
    fit = (
        np.ones((4, regressors + 3, columns), np.float32),
        np.zeros(four, np.float32),
        np.zeros(four, np.float32),
    )
    matrix = np.zeros((regressors, regressors + 3, columns), np.float32)
    model = (np.zeros((3, regressors, columns), np.float32), np.zeros(columns, np.float32))
    solving = (fit, matrix, np.zeros(matrix.shape, np.float64), model)
    weighing = scratch_of(source[0].shape[1], rule[3], tile)
    for top in range(start, stop, rows):
        for left in range(0, rule[1], columns):
            for index in range(weights.shape[0]):
                t, down, right = _offset(index, rule[2])
                where = (centre, t, top, left, down, right)
                tile_weights(source, where, rule, weighing, weights, index)
            _regress_tile(joined, (centre, top, left, start, stop), weights, rule, solving, out)


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
    frames, _, height, width = joined.shape
    window = kernel.window
    joined, source = padded(joined, kernel), (padded(guide, kernel), padded(variance, kernel))
    *rule, numbers = kernel.rule((height, width))
    total = np.zeros((frames, 4, height + 2 * window, width + 2 * window), np.float32)
    with_solver = (*rule, np.append(numbers, np.array(solver, np.float32)))

    def run(rows: Rows) -> Array:
        out = np.zeros((frames, 4, rows[1] - rows[0] + 2 * window, joined.shape[-1]), np.float32)
        _regress_rows(joined, source, (centre, *rows), with_solver, TILE, out)
        return out

    for (start, stop), out in in_threads(run, height, kernel.threads):
        total[:, :, start : stop + 2 * window] += out[..., : width + 2 * window]
    return total[:, :, window : window + height, window : window + width]
