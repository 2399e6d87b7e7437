"""How much arithmetic NFOR's formulas take, and how much the machine can do.

Counted per pixel: one for every addition, multiplication, division, minimum or maximum, two for a product
that is added; an exponential counts as the 18 operations of its polynomial in `models.ops.fused.weights`.
Patch sums are counted as two runs of additions, along rows and along columns. Not counted: indices, moves,
comparisons that skip a neighbour, and the margins of tiles, which are computed twice. Neighbours whose
weights are 0 are skipped by the kernels but counted here, so the rate is that of the formulas.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numba import njit

from models.ops.fused.strips import OPTIONS
from models.ops.fused.vectors import LANES, load, product_added, store

EXPONENTIAL = 18
_DISTANCE = 10
"""Of one channel of one pixel: two differences, a square, a minimum, two sums, a factor, a term, a quotient,
a cap."""
_CHAINS, _ROUNDS = 12, 2000


def weight(channels: int, patch: int, own: bool) -> int:
    """Return the operations of the weights towards one neighbour; `own`: each channel has its own."""
    distances = channels * (_DISTANCE + 4 * patch)
    weights = channels if own else 1
    return distances + (channels - weights) + weights * (2 + EXPONENTIAL)


def nlm(window: int, patch: int, channels: int, images: int = 1) -> int:
    """Return the operations per pixel of a filter that gives each channel its own weights."""
    gathered = channels * (1 + 2 * images)
    return (2 * window + 1) ** 2 * (weight(channels, patch, True) + gathered) + channels * images


def regression(window: int, patch: int, features: int) -> int:
    """Return the operations per pixel of a collaborative regression of three colours."""
    size = 3 + features
    sums = size * (size + 1) // 2 + 3 * size
    products = size + 2 * sums
    predictions = 3 * 2 * (size - 1) + 3 * 2 + 1
    neighbour = weight(3, patch, False) + 2 * features + products + predictions
    return (2 * window + 1) ** 2 * neighbour + solution(size) + 3


def solution(size: int) -> int:
    """Return the operations of one set of normal equations with three right-hand sides."""
    count = size + 2
    for a in range(1, size):
        count += 2 * (size + 3 - a) + 6  # covariances and ridge
        count += 2 + sum(1 + 2 * (size + 3 - r) for r in range(a + 1, size))  # factorisation
        count += 3 * (2 * (size - 1 - a) + 3)  # substitution, and the constant
    return count


@njit(**OPTIONS)
def _chains(values: Any, rounds: int) -> None:
    """Run 12 independent chains of products that are added."""
    x, y = load(values, 0), load(values, LANES)
    a = b = c = d = e = f = g = h = i = j = k = m = load(values, 2 * LANES)
    for _ in range(rounds):
        a, b, c = product_added(a, x, y), product_added(b, x, y), product_added(c, x, y)
        d, e, f = product_added(d, x, y), product_added(e, x, y), product_added(f, x, y)
        g, h, i = product_added(g, x, y), product_added(h, x, y), product_added(i, x, y)
        j, k, m = product_added(j, x, y), product_added(k, x, y), product_added(m, x, y)
    for n, chain in enumerate((a, b, c, d, e, f, g, h, i, j, k, m)):
        store(values, (3 + n) * LANES, chain)


def peak(threads: int) -> dict[str, float]:
    """Return what the machine does at best, in operations per second: chains in registers, and a product."""
    values = [np.full((3 + _CHAINS) * LANES, 0.5, np.float32) for _ in range(threads)]
    _chains(values[0], 1)
    best = {"chains of products that are added": 0.0, "matrix product 2048": 0.0}
    rounds = 100 * _ROUNDS
    matrix = torch.rand(2048, 2048)
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(7):
            began = time.perf_counter()
            list(pool.map(lambda v: _chains(v, rounds), values))
            rate = 2 * _CHAINS * LANES * rounds * threads / (time.perf_counter() - began)
            best["chains of products that are added"] = max(best["chains of products that are added"], rate)
    for _ in range(7):
        began = time.perf_counter()
        torch.mm(matrix, matrix)
        rate = 2 * 2048**3 / (time.perf_counter() - began)
        best["matrix product 2048"] = max(best["matrix product 2048"], rate)
    return best
