"""Weights of non-local means for a tile of pixels towards one offset.

Throughout, `source` is the guide and its scaled variance, (T, C, …) padded; `rule` is `Kernel.rule`; `where`
is the frame of the pixels and that of the neighbours, the tile's first row and column, and the offset.

Every function is compiled by itself and once more inside each caller, so that nesting is kept shallow; and
loops do not branch on what stays the same in them, since the compiler would copy all loops around.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg"
from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from models.ops.fused.strips import INNER, MODES, OPTIONS, Array
from models.ops.nlm import CENTRE_FLOOR

_LEAST, _MEAN = MODES["least"], MODES["mean"]
_CUT = 45.0
"""Smaller weights than exp(-45) = 3e-20 are taken as 0. A window may have so few similar pixels that far less
similar ones decide how a feature enters its fit; a solver in float32 sees those down to about 1e-17, the
square of its precision over the window's size."""


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
def exponential(x):
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


@njit(**INNER)
def patch_rows(source, channels, where, rule, scratch):
    """Write d, added over channels and summed across patches, for a tile and its patch margin into h.

    channels: the first and the last but one; where a pixel or its neighbour lies outside, d is 0.
    """
    guide, variance = source
    row, h, _, _, _ = scratch
    own, other, top, left, down, right = where
    height, width, window, patch, _, numbers = rule
    wide, columns, pad = np.uintp(row.shape[0]), np.uintp(h.shape[1]), window + patch
    low = max(0, max(0, -right) - (left - patch))
    high = max(0, min(width, width - right) - (left - patch))
    x, w = np.uintp(left + window), np.uintp(left + window + right)
    for i in range(h.shape[0]):
        y = top - patch + i
        for j in range(wide):
            row[j] = np.float32(0.0)
        if max(0, -down) <= y < min(height, height - down):
            for c in range(channels[0], channels[1]):
                for j in range(wide):
                    u = guide[own, c, y + pad, x + j] - guide[other, c, y + pad + down, w + j]
                    v, r = variance[own, c, y + pad, x + j], variance[other, c, y + pad + down, w + j]
                    value = (u * u - (v + min(v, r))) / (numbers[0] * (v + r) + numbers[1])
                    row[j] += value if value < numbers[2] else numbers[2]  # NaN becomes the cap
            for j in range(min(low, row.shape[0])):
                row[j] = np.float32(0.0)
            for j in range(np.uintp(high), wide):
                row[j] = np.float32(0.0)
        for j in range(columns):
            h[i, j] = row[j]
        for n in range(np.uintp(1), np.uintp(2 * patch + 1), np.uintp(2)):
            after = n + np.uintp(1)
            for j in range(columns):
                h[i, j] += row[j + n] + row[j + after]


@njit(**INNER)
def shares(start, step, size, patch, values):
    """Write 1 / (patch positions that exist) along one axis, 0 where pixel or neighbour lies outside."""
    first, last = max(0, -step), min(size, size - step)
    for i in range(values.shape[0]):
        place = start + i
        number = min(place + patch, last - 1) - max(place - patch, first) + 1
        values[i] = np.float32(1.0) / np.float32(number) if first <= place < last else np.float32(0.0)


@njit(**INNER)
def tile_weights(source, where, rule, scratch, out, at):
    """Write the weights of a tile towards one offset into out[at], (channels or 1, rows, columns)."""
    _, h, sums, row_shares, column_shares = scratch
    own, other, top, left, down, right = where
    height, width, _, patch, mode, _ = rule
    channels, columns = source[0].shape[1], np.uintp(out.shape[3])
    together = channels if mode == _MEAN else 1
    last = channels - together if mode == _LEAST else 0  # smaller channels only compare their sums
    shares(top, down, height, patch, row_shares)
    shares(left, right, width, patch, column_shares)
    floor = np.float32(CENTRE_FLOOR if own == other and down == 0 and right == 0 else 0.0)
    for c in range(0, channels, together):
        patch_rows(source, (c, c + together), where, rule, scratch)
        target = min(c, out.shape[1] - 1)
        kept = np.float32(1.0 if target < c else 0.0)  # the largest of all channels' sums
        for i in range(out.shape[2]):
            for j in range(columns):
                sums[j] = h[i, j]
            for n in range(1, 2 * patch + 1, 2):
                for j in range(columns):
                    sums[j] += h[i + n, j] + h[i + n + 1, j]
            for j in range(columns):
                sums[j] = max(sums[j], out[at, target, i, j] * kept)
            if c < last:
                for j in range(columns):
                    out[at, target, i, j] = sums[j]
                continue
            share = row_shares[i] / np.float32(together)
            for j in range(columns):
                weight = max(exponential(sums[j] * (column_shares[j] * share)), floor)
                out[at, target, i, j] = weight if column_shares[j] * share > 0.0 else np.float32(0.0)


def scratch_of(patch: int, tile: tuple[int, int]) -> tuple[Array, ...]:
    """Return what `tile_weights` works with: d, sums across, a row of sums, shares of rows and columns."""
    rows, columns = tile
    sizes = (columns + 2 * patch, (rows + 2 * patch, columns), columns, rows, columns)
    return tuple(np.zeros(size, np.float32) for size in sizes)
