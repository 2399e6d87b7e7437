"""Weights of non-local means for a tile of pixels towards one offset.

Throughout, `source` is the guide and its scaled variance, (T, C, …) padded; `rule` is `Kernel.rule`; `where`
is the frame of the pixels and that of the neighbours, the tile's first row and column, and the offset.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg"
from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from models.ops.fused.strips import MODES, OPTIONS

_LEAST, _MEAN = MODES["least"], MODES["mean"]
_CUT = 29.9
"""exp(-29.9) is 1e-13."""


@intrinsic
def _power_of_two(typing_context: Any, shifted: Any) -> Any:
    """Return 2**n from the float32 1.5 * 2**23 + n, whose lowest bits are n."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer = ir.IntType(32)
        bits = builder.bitcast(arguments[0], integer)
        bits = builder.add(builder.shl(bits, ir.Constant(integer, 23)), ir.Constant(integer, 127 << 23))
        return builder.bitcast(bits, ir.FloatType())

    return types.float32(types.float32), generate


@njit(**OPTIONS, inline="always")
def _exponential(x):
    """Return exp(-x) for x >= 0 to 2e-7, 0 from `_CUT` on; compiles to vector instructions.

    exp(-x) = 2**(n + f) with n whole and |f| <= 1/2; 2**f is its Taylor series.
    """
    t = np.float32(-1.4426950408889634) * min(x, np.float32(80.0))
    shifted = t + np.float32(12582912.0)  # 1.5 * 2**23: adding it rounds to a whole number
    f = t - (shifted - np.float32(12582912.0))
    series = np.float32(1.5403530e-4)
    series = series * f + np.float32(1.3333558e-3)
    series = series * f + np.float32(9.6181291e-3)
    series = series * f + np.float32(5.5504109e-2)
    series = series * f + np.float32(2.4022651e-1)
    series = series * f + np.float32(6.9314718e-1)
    series = series * f + np.float32(1.0)
    return series * _power_of_two(shifted) if x < np.float32(_CUT) else np.float32(0.0)


@njit(**OPTIONS)
def _tile_distances(source, channel, where, rule, d):
    """Write d of one channel for a tile and its patch margin, 0 where pixel or neighbour lies outside."""
    guide, variance = source
    own, other, top, left, down, right = where
    height, width, window, patch, _, numbers = rule
    squared_k, epsilon, cap = numbers[0], numbers[1], numbers[2]
    columns = d.shape[1]
    top, left = top - patch, left - patch
    first, last = max(0, -down), min(height, height - down)
    low = min(columns, max(0, max(0, -right) - left))
    high = min(columns, max(0, min(width, width - right) - left))
    x, w = np.uintp(left + window + patch), np.uintp(left + window + patch + right)
    for i in range(d.shape[0]):
        inside = first <= top + i < last
        if inside:
            y = top + i + window + patch
            z = y + down
            for j in range(np.uintp(columns)):
                u = guide[own, channel, y, x + j] - guide[other, channel, z, w + j]
                v, r = variance[own, channel, y, x + j], variance[other, channel, z, w + j]
                value = (u * u - (v + min(v, r))) / (squared_k * (v + r) + epsilon)
                d[i, j] = value if value < cap else cap  # NaN becomes the cap
        for j in range(low if inside else columns):
            d[i, j] = np.float32(0.0)
        for j in range(high, columns):
            d[i, j] = np.float32(0.0)


@njit(**OPTIONS)
def _across(d, h, patch):
    """Sum 2 patch + 1 neighbours of every row."""
    columns = h.shape[1]
    for i in range(h.shape[0]):
        if patch == 3:
            for j in range(columns):
                first = (d[i, j] + d[i, j + 1]) + (d[i, j + 2] + d[i, j + 3])
                h[i, j] = first + ((d[i, j + 4] + d[i, j + 5]) + d[i, j + 6])
        elif patch == 1:
            for j in range(columns):
                h[i, j] = d[i, j] + d[i, j + 1] + d[i, j + 2]
        else:
            for j in range(columns):
                h[i, j] = d[i, j]
            for n in range(1, 2 * patch + 1):
                for j in range(columns):
                    h[i, j] += d[i, j + n]


@njit(**OPTIONS)
def _down(h, out, channel, patch):
    """Sum 2 patch + 1 rows."""
    _, rows, columns = out.shape
    for i in range(rows):
        if patch == 3:
            for j in range(columns):
                first = (h[i, j] + h[i + 1, j]) + (h[i + 2, j] + h[i + 3, j])
                out[channel, i, j] = first + ((h[i + 4, j] + h[i + 5, j]) + h[i + 6, j])
        elif patch == 1:
            for j in range(columns):
                out[channel, i, j] = h[i, j] + h[i + 1, j] + h[i + 2, j]
        else:
            for j in range(columns):
                out[channel, i, j] = h[i, j]
            for n in range(1, 2 * patch + 1):
                for j in range(columns):
                    out[channel, i, j] += h[i + n, j]


@njit(**OPTIONS)
def _shares(start, step, size, patch, shares):
    """Write 1 / (patch positions that exist) along one axis, 0 where pixel or neighbour lies outside."""
    first, last = max(0, -step), min(size, size - step)
    for i in range(shares.shape[0]):
        place = start + i
        number = min(place + patch, last - 1) - max(place - patch, first) + 1
        shares[i] = np.float32(1.0) / np.float32(number) if first <= place < last else np.float32(0.0)


@njit(**OPTIONS)
def _combine(sums, mode):
    """Reduce the channels' patch sums to one, in the first."""
    channels, rows, columns = sums.shape
    for c in range(1, channels):
        for i in range(rows):
            if mode == _LEAST:
                for j in range(columns):
                    sums[0, i, j] = max(sums[0, i, j], sums[c, i, j])
            else:
                for j in range(columns):
                    sums[0, i, j] += sums[c, i, j]
    if mode == _MEAN:
        for i in range(rows):
            for j in range(columns):
                sums[0, i, j] /= np.float32(channels)


@njit(**OPTIONS)
def tile_weights(source, where, rule, scratch, out, at):
    """Write the weights of a tile towards one offset into out[at], (channels or 1, rows, columns)."""
    d, h, sums, rows, columns = scratch
    own, other, top, left, down, right = where
    height, width, _, patch, mode, _ = rule
    _shares(top, down, height, patch, rows)
    _shares(left, right, width, patch, columns)
    for c in range(sums.shape[0]):
        _tile_distances(source, c, where, rule, d)
        _across(d, h, patch)
        _down(h, sums, c, patch)
    if mode in (_LEAST, _MEAN):
        _combine(sums, mode)
    centre = own == other and down == 0 and right == 0
    for c in range(out.shape[1]):
        for i in range(out.shape[2]):
            row_share = rows[i]
            for j in range(out.shape[3]):
                share = row_share * columns[j]
                weight = _exponential(max(np.float32(0.0), sums[c, i, j] * share))
                out[at, c, i, j] = weight if share > np.float32(0.0) else np.float32(0.0)
            if centre:
                for j in range(out.shape[3]):
                    if row_share * columns[j] > np.float32(0.0):
                        out[at, c, i, j] = max(out[at, c, i, j], np.float32(1e-4))


@njit(**OPTIONS)
def scratch_of(channels, patch, tile):
    """Return what `tile_weights` works with: d, sums across, patch sums, shares of rows and columns."""
    rows, columns = tile
    d = np.zeros((rows + 2 * patch, columns + 2 * patch), np.float32)
    h = np.zeros((rows + 2 * patch, columns), np.float32)
    sums = np.zeros((channels, rows, columns), np.float32)
    return d, h, sums, np.zeros(rows, np.float32), np.zeros(columns, np.float32)
