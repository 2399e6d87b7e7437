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
