"""Non-local means written down literally in float64, without box sums, strips or tricks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def shifted(image: Array, down: int, right: int) -> Array:
    """Return image[y + down, x + right] at (y, x), NaN outside of the image."""
    height, width = image.shape[:2]
    result = np.full_like(image, np.nan)
    rows = slice(max(0, -down), min(height, height - down))
    columns = slice(max(0, -right), min(width, width - right))
    there = (
        slice(rows.start + down, rows.stop + down),
        slice(columns.start + right, columns.stop + right),
    )
    if rows.start < rows.stop and columns.start < columns.stop:
        result[rows, columns] = image[there]
    return result


def pixel_distance(u_p: Array, u_q: Array, v_p: Array, v_q: Array, k: float, eps: float) -> Array:
    numerator = (u_p - u_q) ** 2 - (v_p + np.minimum(v_p, v_q))
    return numerator / (eps + k * k * (v_p + v_q))


def patch_distance(
    guide: tuple[Array, Array],
    other: tuple[Array, Array],
    offset: tuple[int, int],
    patch: int,
    k: float,
    eps: float = 1e-7,
    cap: float = 1e4,
    mean_channels: bool = False,
) -> tuple[Array, Array]:
    """Return the patch mean of d (H, W, C) towards p + offset, and whether p + offset is inside (H, W)."""
    inside = np.ones(guide[0].shape[:2])
    u_q, v_q = (shifted(a, *offset) for a in other)
    there = shifted(inside, *offset) == 1
    with np.errstate(invalid="ignore", divide="ignore"):
        d = pixel_distance(guide[0], u_q, guide[1], v_q, k, eps)
    if mean_channels:
        d = d.mean(-1, keepdims=True)
    d = np.where(np.isnan(d), cap, np.minimum(d, cap))
    d[~there] = np.nan
    total, count = np.zeros_like(d), np.zeros_like(d)
    for down in range(-patch, patch + 1):
        for right in range(-patch, patch + 1):
            at = shifted(d, down, right)
            total += np.where(np.isnan(at), 0.0, at)
            count += ~np.isnan(at)
    return total / np.maximum(count, 1), there


def weight(distance: Array, there: Array, offset: tuple[int, int]) -> Array:
    result = np.exp(-np.maximum(0.0, distance)) * there[..., None]
    return np.maximum(result, 1e-4) if offset == (0, 0) else result


def window(radius: int) -> list[tuple[int, int]]:
    return [(y, x) for y in range(-radius, radius + 1) for x in range(-radius, radius + 1)]


def nlm(
    image: Array, guide: Array, variance: Array, patch: int, radius: int, k: float, scale: float, **how: float
) -> Array:
    """Filter (H, W, C) with the weights of `guide`, every channel with its own."""
    total, norm = np.zeros_like(image), np.zeros_like(image)
    source = (guide, scale * variance)
    for offset in window(radius):
        distance, there = patch_distance(source, source, offset, patch, k, **how)  # type: ignore[arg-type]
        w = weight(distance, there, offset)
        total += w * np.nan_to_num(shifted(image, *offset))
        norm += w
    return total / norm


def mirrored(place: int, size: int) -> int:
    """Return the pixel that stands for a place outside, the border pixel being repeated first."""
    while not 0 <= place < size:
        place = -1 - place if place < 0 else 2 * size - 1 - place
    return place


def neighbour(image: Array, down: int, right: int) -> Array:
    height, width = image.shape[:2]
    rows = [mirrored(y + down, height) for y in range(height)]
    columns = [mirrored(x + right, width) for x in range(width)]
    return image[rows][:, columns]


def box_mean(image: Array, radius: int, full_width: bool = False) -> Array:
    """Average the part of every box that is inside; `full_width`: divide columns by 2 radius + 1 always."""
    height, width = image.shape
    result = np.zeros_like(image)
    for y in range(height):
        top, bottom = max(0, y - radius), min(height, y + radius + 1)
        for x in range(width):
            left, right = max(0, x - radius), min(width, x + radius + 1)
            columns = 2 * radius + 1 if full_width else right - left
            result[y, x] = image[top:bottom, left:right].sum() / ((bottom - top) * columns)
    return result


def rkz12(
    image: Array, guide: Array, variance: Array, patch: int, radius: int, k: float, symmetric: bool = True
) -> Array:
    """Filter (H, W, 3) as the released code of RKZ12; `variance` is that of the guide's pixels."""

    def to_weight(numerator: Array, spread: Array) -> Array:
        d = (numerator / (1e-10 + k * k * spread)).mean(-1)
        return np.asarray(np.exp(-np.maximum(0.0, box_mean(d, patch))))

    total, norm = image.copy(), np.ones(image.shape[:2])
    half = [(y, x) for y, x in window(radius) if (y, x) > (0, 0)]
    for down, right in half:
        sides = [(down, right), (-down, -right)]
        u, v = ([neighbour(source, *side) for side in sides] for source in (guide, variance))
        least = [np.minimum(variance, side) for side in v]
        weights = [to_weight((guide - u[i]) ** 2 - (variance + least[i]), variance + v[i]) for i in range(2)]
        if symmetric:
            square = (guide - (u[0] + u[1]) / 2) ** 2
            both = to_weight(square - (variance + (least[0] + least[1]) / 4), variance + (v[0] + v[1]) / 4)
            with np.errstate(divide="ignore", invalid="ignore"):
                r = np.clip(np.nan_to_num(both / (weights[0] + weights[1]), posinf=9.0) - 1, 0, 1)
            weights = [r * both + (1 - r) * w for w in weights]
        for side, w in zip(sides, weights, strict=True):
            smooth = box_mean(w, patch, full_width=True)
            smooth[smooth < 0.05] = 0
            total += smooth[..., None] * neighbour(image, *side)
            norm += smooth
    return np.asarray(total / norm[..., None])


def feature_distance(
    feature: Array, variance: Array, spread: Array, offset: tuple[int, int], k: float
) -> Array:
    """Return RDFC's distance of a feature (H, W) towards p + offset, the mean of its channels."""
    f, v, t = (shifted(a, *offset) for a in (feature, variance, spread))
    numerator = (feature - f) ** 2 - (variance + np.minimum(variance, v))
    return np.asarray((numerator / (1e-10 + k * k * (spread + t))).mean(-1))


def gradient(feature: Array) -> Array:
    """Return |grad f|^2 per channel: the smaller of both half differences squared, per axis."""
    height, width, _ = feature.shape
    result = np.zeros_like(feature)
    for y in range(height):
        for x in range(width):
            for axis, place, size in ((0, y, height), (1, x, width)):
                if 0 < place < size - 1:
                    step = np.array([1, 0]) if axis == 0 else np.array([0, 1])
                    before, after = feature[y - step[0], x - step[1]], feature[y + step[0], x + step[1]]
                    here = feature[y, x]
                    result[y, x] += np.minimum(((before - here) / 2) ** 2, ((after - here) / 2) ** 2)
    return result


def joint(
    image: Array,
    color: tuple[Array, Array],
    features: list[tuple[Array, Array, Array | float]],
    numbers: tuple[int, int, float, float],
    product: bool,
) -> Array:
    """Filter with the weights of a colour guide and its variance, and of features, variances and their tau.

    numbers: radius of the window, of the patch, k of the colour, k of the features.
    """
    radius, patch, k_color, k_features = numbers
    total, norm = np.zeros_like(image), np.zeros((*image.shape[:2], 1))
    spreads = [np.maximum(np.maximum(v, gradient(f)), tau) for f, v, tau in features]
    for offset in window(radius):
        d, there = patch_distance(color, color, offset, patch, k_color, 1e-10, mean_channels=True)
        w = weight(d, there, offset)[..., 0]
        for (f, v, _), t in zip(features, spreads, strict=True):
            own = np.exp(-np.maximum(0.0, feature_distance(f, v, t, offset, k_features)))
            own = np.where(there, own, 0.0)
            w = w * own if product else np.minimum(w, own)
        total += w[..., None] * np.nan_to_num(shifted(image, *offset))
        norm += w[..., None]
    return total / norm
