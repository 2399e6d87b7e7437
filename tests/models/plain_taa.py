"""The antialiasing of BMFR written down literally in float64, pixel by pixel, from Koskela et al. 2019."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def inside(image: Array, q: tuple[int, int]) -> bool:
    return 0 <= q[0] < image.shape[0] and 0 <= q[1] < image.shape[1]


def to_ycocg(c: Array) -> Array:
    luma = 0.25 * c[0] + 0.5 * c[1] + 0.25 * c[2]
    return np.array([luma, 0.5 * (c[0] - c[2]), 0.5 * (c[1] - 0.5 * (c[0] + c[2]))])


def from_ycocg(c: Array) -> Array:
    return np.array([c[0] + c[1] - c[2], c[0] + c[2], c[0] - c[1] - c[2]])


def taa(image: Array, last: Array, motion: Array) -> Array:
    """Antialias linear radiance on display values."""
    shown, old = np.maximum(image, 0) ** 0.454545, np.maximum(last, 0) ** 0.454545
    result = image.copy()
    for p in np.ndindex(*image.shape[:2]):
        x, y = p[1] + motion[p][0], p[0] + motion[p][1]
        if not (math.isfinite(x) and math.isfinite(y)) or max(abs(x), abs(y)) > 1e6:
            continue
        total, fetched = 0.0, np.zeros(3)
        for v in (math.floor(y), math.floor(y) + 1):
            for u in (math.floor(x), math.floor(x) + 1):
                if inside(image, (v, u)):
                    share = (1 - abs(x - u)) * (1 - abs(y - v))
                    total += share
                    fetched = fetched + share * to_ycocg(old[v, u])
        if total == 0:
            continue
        box, cross = [], []
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                q = (p[0] + down, p[1] + right)
                if inside(image, q):
                    box.append(to_ycocg(shown[q]))
                    if down == 0 or right == 0:
                        cross.append(box[-1])
        low = (np.min(box, 0) + np.min(cross, 0)) / 2
        high = (np.max(box, 0) + np.max(cross, 0)) / 2
        blended = 0.2 * to_ycocg(shown[p]) + 0.8 * np.minimum(np.maximum(fetched / total, low), high)
        result[p] = np.maximum(from_ycocg(blended), 0) ** (1 / 0.454545)
    return result
