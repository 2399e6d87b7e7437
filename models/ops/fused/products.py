"""Sums of products over the neighbours of a pixel, which lie side by side, and small systems of equations."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from models.ops.fused.strips import INNER

SUMS: dict[str, Any] = {**INNER, "fastmath": {"contract", "nsz", "reassoc"}}
"""For kernels that add up numbers, in whatever order suits vector instructions."""


@njit(**SUMS)
def _block(z, w, a, b, count, out):
    """Sum the weighted products of three rows with four."""
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = s20 = s21 = s22 = s23 = 0.0
    for n in range(count):
        x0, x1, x2 = w[n] * z[a, n], w[n] * z[a + 1, n], w[n] * z[a + 2, n]
        y0, y1, y2, y3 = z[b, n], z[b + 1, n], z[b + 2, n], z[b + 3, n]
        s00, s01, s02, s03 = s00 + x0 * y0, s01 + x0 * y1, s02 + x0 * y2, s03 + x0 * y3
        s10, s11, s12, s13 = s10 + x1 * y0, s11 + x1 * y1, s12 + x1 * y2, s13 + x1 * y3
        s20, s21, s22, s23 = s20 + x2 * y0, s21 + x2 * y1, s22 + x2 * y2, s23 + x2 * y3
    out[a, b], out[a, b + 1], out[a, b + 2], out[a, b + 3] = s00, s01, s02, s03
    a += 1
    out[a, b], out[a, b + 1], out[a, b + 2], out[a, b + 3] = s10, s11, s12, s13
    a += 1
    out[a, b], out[a, b + 1], out[a, b + 2], out[a, b + 3] = s20, s21, s22, s23


@njit(**INNER)
def products(z, w, size, stop, count, out):
    """Write sum w z_a z_b for rows a < size, a <= b < stop; rows up to stop + 2 are read, and meaningless."""
    for a in range(0, size, 3):
        for b in range(a, stop, 4):
            _block(z, w, np.uintp(a), np.uintp(b), np.uintp(count), out)


@njit(**INNER)
def combined(rows, factors, size, count, out, at):
    """Write the sum of rows times factors into out[at]; factors beyond `size` must be 0, up to three."""
    for n in range(np.uintp(count)):
        out[at, n] = 0.0
    for a in range(0, size, 4):
        f0, f1, f2, f3 = factors[a], factors[a + 1], factors[a + 2], factors[a + 3]
        r = np.uintp(a)
        s, t, u = r + np.uintp(1), r + np.uintp(2), r + np.uintp(3)
        for n in range(np.uintp(count)):
            out[at, n] += f0 * rows[r, n] + f1 * rows[s, n] + f2 * rows[t, n] + f3 * rows[u, n]


@njit(**INNER)
def solve(m, size, right, out):
    """Solve for the `right` columns that stand beside the upper triangle; out[c] gets the solutions."""
    for a in range(size):
        inverse = 1.0 / m[a, a]
        for r in range(a + 1, size):
            factor = m[a, r] * inverse
            for b in range(r, size + right):
                m[r, b] -= factor * m[a, b]
    for c in range(right):
        for a in range(size - 1, -1, -1):
            value = m[a, size + c]
            for b in range(a + 1, size):
                value -= m[a, b] * out[c, b]
            out[c, a] = value / m[a, a]
