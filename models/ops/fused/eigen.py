"""Eigenvectors of many small symmetric matrices, by Jacobi's rotations.

Matrices lie side by side along the last axis, so that a rotation is the same arithmetic for neighbouring
numbers. Every pair of rows is rotated in turn until nothing beside the diagonals exceeds rounding, six to
eight times for 9x9. A matrix that is diagonal is left alone: its eigenvectors are exactly the axes.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

import math

import numpy as np
from numba import njit

from models.ops.fused.products import SUMS
from models.ops.fused.strips import INNER

_ROUNDING = 1e-17
"""Relative to the trace, below this what is beside the diagonal counts as 0."""

_SWEEPS = 20


@njit(**INNER)
def _turn(m, first, second, cosine, sine):
    """Rotate two entries of all matrices by the angle of each."""
    a, b = first
    c, d = second
    for j in range(np.uintp(m.shape[2])):
        x, y = m[a, b, j], m[c, d, j]
        m[a, b, j] = cosine[j] * x - sine[j] * y
        m[c, d, j] = sine[j] * x + cosine[j] * y


@njit(**SUMS)
def _angles(m, p, q, limit, cosine, sine):
    """Make entry p, q of all matrices 0 where it is above the limit; returns how many there were."""
    lanes = np.uintp(m.shape[2])
    found = 0.0
    for j in range(lanes):  # tangents, of the smaller angle
        x, apart = m[p, q, j], m[q, q, j] - m[p, p, j]
        double = 2 * x if apart >= 0 else -2 * x
        size = abs(x)
        tangent = double / (abs(apart) + math.sqrt(apart * apart + 4 * x * x) + 1e-300)
        sine[j] = tangent if size > limit[j] else 0.0
    for j in range(lanes):
        found += 1.0 if sine[j] != 0.0 else 0.0
    if found == 0.0:
        return found
    for j in range(lanes):
        m[p, p, j] -= sine[j] * m[p, q, j]
    for j in range(lanes):
        m[q, q, j] += sine[j] * m[p, q, j]
    for j in range(lanes):
        m[p, q, j] = 0.0 if sine[j] != 0.0 else m[p, q, j]
    for j in range(lanes):
        cosine[j] = 1 / math.sqrt(1 + sine[j] * sine[j])
    for j in range(lanes):
        sine[j] *= cosine[j]
    return found


@njit(**INNER)
def eigenvectors(m, v, work):
    """Make matrices diagonal; v becomes their eigenvectors.

    Args:
        m: Upper triangles (D, D, lanes); the diagonals become eigenvalues, in any order.
        v: (D, D, lanes), column i belongs to eigenvalue i.
        work: (3, lanes).
    """
    size, lanes = m.shape[0], m.shape[2]
    limit, cosine, sine = work[0], work[1], work[2]
    for j in range(lanes):
        limit[j] = 0.0
        for a in range(size):
            limit[j] += _ROUNDING * m[a, a, j]
            for b in range(size):
                v[a, b, j] = 1.0 if a == b else 0.0
    for _ in range(_SWEEPS):
        turned = 0.0
        for p in range(size - 1):
            for q in range(p + 1, size):
                found = _angles(m, p, q, limit, cosine, sine)
                if found == 0.0:
                    continue
                turned += found
                for k in range(p):
                    _turn(m, (k, p), (k, q), cosine, sine)
                for k in range(p + 1, q):
                    _turn(m, (p, k), (k, q), cosine, sine)
                for k in range(q + 1, size):
                    _turn(m, (p, k), (q, k), cosine, sine)
                for k in range(size):
                    _turn(v, (k, p), (k, q), cosine, sine)
        if turned == 0.0:
            return
