"""The pyramid of multi-scale non-local means and the smoothed bilateral filter, literally in float64."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tests.models.plain_nlm import Array


def low_pass() -> dict[int, float]:
    """Return weights of fine pixels 2 y + i around coarse pixel y, whose centre lies at 2 y + 1/2."""
    sigma = 0.55 * math.sqrt(1 / 0.5**2 - 1)
    raw = {i: math.exp(-((i - 0.5) ** 2) / (2 * sigma**2)) for i in range(-9, 11)}
    kept = {i: value for i, value in raw.items() if value >= 1e-2}
    return {i: value / sum(kept.values()) for i, value in kept.items()}


def coarser(image: Array, power: int = 1) -> Array:
    """Halve an even image; power 2 propagates a variance."""
    height, width, channels = image.shape
    taps = {i: weight**power for i, weight in low_pass().items()}
    result = np.zeros((height // 2, width // 2, channels))
    for y in range(height // 2):
        for x in range(width // 2):
            for i, down in taps.items():
                for j, across in taps.items():
                    row, column = min(max(2 * y + i, 0), height - 1), min(max(2 * x + j, 0), width - 1)
                    result[y, x] += down * across * image[row, column]
    return result


def cubic(t: float, a: float = -0.75) -> float:
    t = abs(t)
    if t <= 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * t**3 - 5 * a * t**2 + 8 * a * t - 4 * a if t < 2 else 0.0


def finer(image: Array) -> Array:
    height, width, channels = image.shape
    result = np.zeros((2 * height, 2 * width, channels))
    for y in range(2 * height):
        for x in range(2 * width):
            v, u = (y + 0.5) / 2 - 0.5, (x + 0.5) / 2 - 0.5
            for row in range(math.floor(v) - 1, math.floor(v) + 3):
                for column in range(math.floor(u) - 1, math.floor(u) + 3):
                    there = image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
                    result[y, x] += cubic(v - row) * cubic(u - column) * there
    return result


def multi_scale(
    images: tuple[Array, Array], variance: Array, scales: int, nlm: Callable[..., Array]
) -> Array:
    """Return the mean of both halves; nlm(image, guide, variance) filters one scale."""
    height, width, _ = variance.shape
    side = 2 ** (scales - 1)
    padding = ((0, -height % side), (0, -width % side), (0, 0))
    a, b, variance = (np.pad(x, padding, mode="edge") for x in (*images, variance))

    def scale(a: Array, b: Array, variance: Array, left: int) -> tuple[Array, Array]:
        fine = nlm(a, b, variance), nlm(b, a, variance)
        if left == 1:
            return fine
        coarse = scale(coarser(a), coarser(b), coarser(variance, 2), left - 1)
        first, second = (f + finer(c) - finer(coarser(f)) for f, c in zip(fine, coarse, strict=True))
        return first, second

    first, second = scale(a, b, variance, scales)
    return 0.5 * (first + second)[:height, :width]


def bilateral(color: Array, radius: int, spatial: float, tonal: float, smoothing: float) -> Array:
    """Filter (H, W, 3) with weights of its smoothed logarithm."""
    height, width, _ = color.shape
    guide, reach = np.log1p(color), math.ceil(2 * smoothing)

    def around(y: int, x: int, r: int) -> list[tuple[int, int]]:
        rows = range(max(0, y - r), min(height, y + r + 1))
        return [(i, j) for i in rows for j in range(max(0, x - r), min(width, x + r + 1))]

    def mean(image: Array, y: int, x: int, weights: dict[tuple[int, int], float]) -> Array:
        total = sum(w * image[place] for place, w in weights.items())
        return np.asarray(total / sum(weights.values()))

    def near(y: int, x: int, place: tuple[int, int], sigma: float) -> float:
        return math.exp(-((place[0] - y) ** 2 + (place[1] - x) ** 2) / (2 * sigma**2))

    if smoothing:
        guide = np.array(
            [
                [
                    mean(guide, y, x, {p: near(y, x, p, smoothing) for p in around(y, x, reach)})
                    for x in range(width)
                ]
                for y in range(height)
            ]
        )
    result = np.zeros_like(color)
    for y in range(height):
        for x in range(width):
            weights = {}
            for place in around(y, x, radius):
                distance = ((guide[place] - guide[y, x]) ** 2).sum() / (2 * tonal**2)
                weights[place] = near(y, x, place, spatial) * math.exp(-distance)
            result[y, x] = mean(color, y, x, weights)
    return result
