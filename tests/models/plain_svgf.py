"""SVGF written down literally in float64, pixel by pixel, from Schied et al. 2017 and the released pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tests.models.plain_taa import Array, inside, taa

Frame = dict[str, Array]
"""Buffers (H, W, C) of a frame: irradiance, albedo, normal, depth, motion, position."""

KERNEL = {0: 1.0, 1: 2 / 3, 2: 1 / 6}


@dataclass
class Options:
    iterations: int = 5
    feedback: int = 1
    alpha: float = 0.2
    moments_alpha: float = 0.2
    sigma_z: float = 1.0
    sigma_n: float = 128.0
    sigma_l: float = 4.0
    along: bool = False
    prefilter: bool = True
    young_radius: int = 3
    position_limit_squared: float | None = None
    depth_floor: float | None = None
    margin: int = 0
    taa: bool = True


def grey(color: Array) -> float:
    return float(0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2])


def slope(image: Array, y: int, x: int, down: int, right: int) -> Array:
    """Return the smaller of the differences to both neighbours along an axis, per channel.

    Where one of them is missing, the difference of the other one from the next is taken instead.
    """
    found = []
    for side in (1, -1):
        for step in (0, -2 * side):
            q, other = (
                (y + step * down, x + step * right),
                (y + (step + side) * down, x + (step + side) * right),
            )
            if inside(image, q) and inside(image, other):
                found.append(side * (image[other] - image[q]))
                break
    if not found:
        return np.zeros(image.shape[2])
    return np.array([min((f[c] for f in found), key=abs) for c in range(image.shape[2])])


def fwidth(image: Array, y: int, x: int) -> float:
    sides = np.abs(slope(image, y, x, 0, 1)) + np.abs(slope(image, y, x, 1, 0))
    return float(np.sqrt((sides**2).sum()))


def unit(normal: Array) -> Array:
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal / np.where(length > 0, length, 1)


def valid(now: Frame, past: Frame, p: tuple[int, int], q: tuple[int, int], o: Options) -> bool:
    """Say whether pixel q of the frame before shows the surface of pixel p."""
    height, width = now["depth"].shape[:2]
    if not (o.margin <= q[0] < height - o.margin and o.margin <= q[1] < width - o.margin):
        return False
    normal = np.linalg.norm(now["normal"][p] - past["normal"][q])
    if normal / (fwidth(now["normal"], *p) + 0.01) > 16:
        return False
    if o.position_limit_squared is not None:
        return float(((now["position"][p] - past["position"][q]) ** 2).sum()) < o.position_limit_squared
    z = float(now["depth"][p][0])
    floor = 0.001 * z if o.depth_floor is None else o.depth_floor
    return abs(float(past["depth"][q][0]) - z) <= 10 * (fwidth(now["depth"], *p) + floor)


def history(now: Frame, past: Frame, p: tuple[int, int], o: Options) -> tuple[Array, Array, float] | None:
    """Return colour, moments and number of frames of the frame before, None where it does not know."""
    x, y = p[1] + now["motion"][p][0], p[0] + now["motion"][p][1]
    if not (math.isfinite(x) and math.isfinite(y)) or max(abs(x), abs(y)) > 1e6:
        return None
    left, top = math.floor(x), math.floor(y)
    found: list[tuple[float, tuple[int, int]]] = []
    for v in (top, top + 1):
        for u in (left, left + 1):
            share = (1 - abs(x - u)) * (1 - abs(y - v))
            if valid(now, past, p, (v, u), o):
                found.append((share, (v, u)))
    if sum(share for share, _ in found) < 0.01:
        v, u = math.floor(y + 0.5), math.floor(x + 0.5)
        around = [(v + j, u + i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        found = [(1.0, q) for q in around if valid(now, past, p, q, o)]
    total = sum(share for share, _ in found)
    if not found:
        return None
    color = sum(share * past["color"][q] for share, q in found) / total
    moments = sum(share * past["moments"][q] for share, q in found) / total
    count = sum(share * past["count"][q][0] for share, q in found) / total
    return color, moments, float(count)


def accumulate(now: Frame, past: Frame | None, o: Options) -> tuple[Array, Array, Array]:
    light = now["irradiance"]
    color = light.copy()
    moments = np.stack([[[grey(c), grey(c) ** 2] for c in row] for row in light])
    count = np.ones((*light.shape[:2], 1))
    for p in np.ndindex(*light.shape[:2]):
        known = None if past is None else history(now, past, p, o)
        if known is None:
            continue
        count[p] = min(known[2] + 1, 32)
        a, b = (max(alpha, 1 / count[p][0]) for alpha in (o.alpha, o.moments_alpha))
        color[p] = a * light[p] + (1 - a) * known[0]
        moments[p] = b * moments[p] + (1 - b) * known[1]
    return color, moments, count


def depth_slopes(depth: Array) -> Array:
    result = np.zeros((*depth.shape[:2], 2))
    for p in np.ndindex(*depth.shape[:2]):
        result[p] = slope(depth, *p, 0, 1)[0], slope(depth, *p, 1, 0)[0]
    return result


def edge_weight(now: Frame, p: tuple[int, int], q: tuple[int, int], o: Options) -> float:
    """Return the part of the weight that normals and depths decide."""
    if now["depth"][p][0] == 0 or now["depth"][q][0] == 0:
        return 0.0
    down, right = q[0] - p[0], q[1] - p[1]
    gx, gy = now["slopes"][p]
    change = abs(gx * right + gy * down) if o.along else max(abs(gx), abs(gy)) * math.hypot(down, right)
    apart = abs(now["depth"][p][0] - now["depth"][q][0]) / (o.sigma_z * max(change, 1e-8))
    return max(0.0, float(now["normal"][p] @ now["normal"][q])) ** o.sigma_n * math.exp(-apart)


def young_pixels(now: Frame, color: Array, moments: Array, count: Array, o: Options) -> tuple[Array, Array]:
    """Return colour and variance, for pixels with less than 4 frames from neighbours around."""
    result, variance = color.copy(), np.maximum(moments[..., 1] - moments[..., 0] ** 2, 0)
    reach = range(-o.young_radius, o.young_radius + 1)
    for p in np.ndindex(*color.shape[:2]):
        if count[p][0] >= 4:
            continue
        total, mean, mean_moments = 0.0, np.zeros(3), np.zeros(2)
        for down in reach:
            for right in reach:
                q = (p[0] + down, p[1] + right)
                if not inside(color, q):
                    continue
                w = 1.0
                if q != p:
                    apart = abs(grey(color[p]) - grey(color[q])) / o.sigma_l
                    w = edge_weight(now, p, q, o) * math.exp(-apart)
                total += w
                mean = mean + w * color[q]
                mean_moments = mean_moments + w * moments[q]
        mean_moments /= total
        variance[p] = max(mean_moments[1] - mean_moments[0] ** 2, 0) * 4 / count[p][0]
        if o.prefilter:
            result[p] = mean / total
    return result, variance


def gaussian(variance: Array, p: tuple[int, int]) -> float:
    total = norm = 0.0
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            q = (p[0] + down, p[1] + right)
            if inside(variance, q):
                k = {0: 1 / 4, 1: 1 / 8, 2: 1 / 16}[abs(down) + abs(right)]
                total += k * variance[q]
                norm += k
    return total / norm


def atrous(now: Frame, color: Array, variance: Array, step: int, o: Options) -> tuple[Array, Array]:
    result, result_variance = np.zeros_like(color), np.zeros_like(variance)
    for p in np.ndindex(*variance.shape):
        spread = o.sigma_l * math.sqrt(gaussian(variance, p) + 1e-10)
        total, squares, norm = np.zeros(3), 0.0, 0.0
        for j in range(-2, 3):
            for i in range(-2, 3):
                q = (p[0] + j * step, p[1] + i * step)
                if not inside(variance, q):
                    continue
                w = KERNEL[abs(j)] * KERNEL[abs(i)]
                if q != p:
                    w *= edge_weight(now, p, q, o)
                    w *= math.exp(-abs(grey(color[p]) - grey(color[q])) / spread)
                total = total + w * color[q]
                squares += w * w * variance[q]
                norm += w
        result[p], result_variance[p] = total / norm, squares / norm**2
    return result, result_variance


def svgf(sequence: list[Frame], o: Options) -> list[Frame]:
    """Return color (with albedo), count and variance of every frame."""
    past: Frame | None = None
    results = []
    for given in sequence:
        now = {**given, "normal": unit(given["normal"]), "slopes": depth_slopes(given["depth"])}
        accumulated, moments, count = accumulate(now, past, o)
        color, variance = young_pixels(now, accumulated, moments, count, o)
        entered, remembered = variance, color
        for i in range(o.iterations):
            color, variance = atrous(now, color, variance, 2**i, o)
            if i + 1 == o.feedback:
                remembered = color
        output = color * now["albedo"]
        if o.taa and past is not None:
            output = taa(output, past["output"], now["motion"])
        past = {**now, "color": remembered, "moments": moments, "count": count, "output": output}
        results.append({"color": output, "count": count, "variance": entered[..., None]})
    return results
