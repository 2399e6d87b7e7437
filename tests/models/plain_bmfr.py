"""BMFR written down literally in float64, pixel by pixel and block by block, from Koskela et al. 2019."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tests.models.plain_taa import Array, inside, taa

Frame = dict[str, Array]
"""Buffers (H, W, C) of a frame: irradiance, albedo, normal, position, motion."""

OFFSETS = [
    *[(-14, -14), (4, -6), (-8, 14), (8, 0), (-10, -8), (2, 12), (12, -12), (-10, 0)],
    *[(12, 14), (-8, -16), (6, 6), (-2, -2), (6, -14), (-16, 12), (14, -4), (-6, 4)],
]


@dataclass
class Options:
    position_limit_squared: float
    normal_limit_squared: float = 1.0
    noise: float = 0.01
    always_scale: bool = False
    half: bool = False
    taa: bool = True
    cut: bool = False
    side: int = 32


def accepted(now: Frame, past: Frame, p: tuple[int, int], o: Options) -> list[tuple[float, tuple[int, int]]]:
    """Return share and place of the bilinear neighbours that show the same surface."""
    x, y = p[1] + now["motion"][p][0], p[0] + now["motion"][p][1]
    found = []
    for v in (math.floor(y), math.floor(y) + 1):
        for u in (math.floor(x), math.floor(x) + 1):
            if not inside(now["position"], (v, u)):
                continue
            place = now["position"][p] - past["position"][v, u]
            normal = now["normal"][p] - past["normal"][v, u]
            if place @ place < o.position_limit_squared and normal @ normal < o.normal_limit_squared:
                found.append(((1 - abs(x - u)) * (1 - abs(y - v)), (v, u)))
    return found if sum(share for share, _ in found) > 0 else []


def mean(plane: Array, taps: list[tuple[float, tuple[int, int]]]) -> Array:
    total = sum(share for share, _ in taps)
    return np.asarray(sum(share * plane[q] for share, q in taps) / total)


def mirror(i: int, size: int) -> int:
    while not 0 <= i < size:
        i = -i - 1 if i < 0 else 2 * size - i - 1
    return i


def uniform(pixel: int, feature: int, frame: int, side: int = 32) -> float:
    """Return a number in [-1, 1] that a hash of 32 bits decides."""
    h = (pixel + side**2 * (feature + 10 * frame)) % 2**32
    h ^= h >> 16
    h = h * 0x85EBCA6B % 2**32
    h ^= h >> 13
    h = h * 0xC2B2AE35 % 2**32
    h ^= h >> 16
    return 2 * h / (2**32 - 1) - 1


def block_matrix(now: Frame, noisy: Array, top: int, left: int, o: Options) -> tuple[Array, Array]:
    """Return features (side^2, 10) and light (side^2, 3) of a block."""
    height, width = noisy.shape[:2]
    features, light = [], []
    for i in range(o.side**2):
        q = (mirror(top + i // o.side, height), mirror(left + i % o.side, width))
        world = now["position"][q]
        features.append([1.0, *now["normal"][q], *world, *(world * world)])
        light.append(noisy[q])
    matrix, colors = np.array(features), np.array(light)
    if o.half:
        single = (x.clip(-65504, 65504).astype(np.float32) for x in (matrix, colors))
        matrix, colors = (x.astype(np.float16).astype(float) for x in single)
    for column in range(4, 10):
        low, high = matrix[:, column].min(), matrix[:, column].max()
        matrix[:, column] -= low
        if high - low > (0 if o.always_scale else 1):
            matrix[:, column] /= high - low
    return matrix, colors


def regression(now: Frame, noisy: Array, number: int, o: Options) -> Array:
    height, width = noisy.shape[:2]
    right, down = (int(offset * o.side / 32) for offset in OFFSETS[number % 16])
    pixels = range(o.side**2)
    noise = np.array([[uniform(i, f, number, o.side) if f else 0.0 for f in range(10)] for i in pixels])
    result = np.full_like(noisy, np.nan)
    for top in range(down - o.side // 2, height, o.side):
        for left in range(right - o.side // 2, width, o.side):
            matrix, colors = block_matrix(now, noisy, top, left, o)
            upper = np.linalg.qr(np.hstack([matrix + o.noise * noise, colors]), mode="r")
            weights = np.linalg.solve(upper[:10, :10], upper[:10, 10:])
            fitted = matrix @ weights
            for i in pixels:
                q = (top + i // o.side, left + i % o.side)
                if inside(noisy, q):
                    result[q] = np.maximum(fitted[i], 0)
    return result


def bmfr(sequence: list[Frame], o: Options) -> list[Frame]:
    """Return color (with albedo), noisy, fitted and count of every frame."""
    past: Frame | None = None
    results: list[Frame] = []
    for number, now in enumerate(sequence):
        noisy, count = now["irradiance"].copy(), np.ones((*now["irradiance"].shape[:2], 1))
        taps = {p: accepted(now, past, p, o) if past else [] for p in np.ndindex(*noisy.shape[:2])}
        for p, found in taps.items():
            if past is not None and found:
                spp = float(mean(past["count"], found)[0])
                alpha = max(1 / (spp + 1), 0.2)
                noisy[p] = alpha * noisy[p] + (1 - alpha) * mean(past["noisy"], found)
                count[p] = min(round(spp) + 1, 255)
        fitted = regression(now, noisy, number, o)
        filtered = fitted.copy()
        for p, found in taps.items():
            if past is not None and found:
                alpha = max(1 / count[p][0], 0.1)
                filtered[p] = alpha * fitted[p] + (1 - alpha) * mean(past["filtered"], found)
        output = filtered * now["albedo"]
        if o.cut:
            output = np.minimum(output, 1)
        if o.taa and past is not None:
            output = taa(output, past["output"], now["motion"])
        past = {**now, "noisy": noisy, "filtered": filtered, "count": count, "output": output}
        results.append({"color": output, "noisy": noisy, "fitted": fitted, "count": count})
    return results
