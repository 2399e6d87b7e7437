"""Non-local means as one would write it down, pixel by pixel: what the benchmark compares with."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.ops.nlm import PatchKernel

Array = NDArray[np.float32]


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _filter_rows(image: Any, variance: Any, rows: Any, numbers: Any, out: Any) -> None:
    window, patch, square, epsilon = numbers
    channels, height, width = image.shape
    for y in range(rows[0], rows[1]):
        for x in range(width):
            norm = np.float32(0.0)
            for v in range(max(0, y - window), min(height, y + window + 1)):
                for u in range(max(0, x - window), min(width, x + window + 1)):
                    total, count = np.float32(0.0), 0
                    for n in range(-patch, patch + 1):
                        for m in range(-patch, patch + 1):
                            a, b, c, d = y + n, x + m, v + n, u + m
                            if not (
                                0 <= a < height and 0 <= b < width and 0 <= c < height and 0 <= d < width
                            ):
                                continue
                            count += 1
                            for k in range(channels):
                                difference = image[k, a, b] - image[k, c, d]
                                p, q = variance[k, a, b], variance[k, c, d]
                                noise = p + min(p, q)
                                value = (difference * difference - noise) / (square * (p + q) + epsilon)
                                total += min(value, np.float32(1e4))
                    weight = np.float32(math.exp(-max(np.float32(0.0), total / np.float32(count * channels))))
                    norm += weight
                    for k in range(channels):
                        out[k, y, x] += weight * image[k, v, u]
            for k in range(channels):
                out[k, y, x] /= norm


def plain_filter(image: Array, variance: Array, kernel: PatchKernel, rows: int, threads: int) -> Array:
    """Filter the first rows of an image (C, H, W) by itself, every patch pixel by pixel, compiled."""
    out = np.zeros((image.shape[0], rows, image.shape[2]), np.float32)
    (bandwidth,) = kernel.bandwidths
    numbers = (kernel.window, kernel.patch, np.float32(bandwidth**2), np.float32(kernel.epsilon))
    cuts = [rows * i // (4 * threads) for i in range(4 * threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda piece: _filter_rows(image, variance, piece, numbers, out), pairwise(cuts)))
    return out


def array_filter(image: Array, variance: Array, kernel: PatchKernel, place: tuple[int, int]) -> Array:
    """Return one filtered pixel (C,) inside the image, its whole window of patches as arrays."""
    window, patch = kernel.window, kernel.patch
    (bandwidth,) = kernel.bandwidths
    reach, (y, x), side = window + patch, place, 2 * patch + 1
    near = (slice(None), slice(y - reach, y + reach + 1), slice(x - reach, x + reach + 1))
    patches, spreads = (
        np.lib.stride_tricks.sliding_window_view(part[near], (side, side), axis=(1, 2))
        for part in (image, variance)
    )
    own, noise = patches[:, window, window][:, None, None], spreads[:, window, window][:, None, None]
    above = (patches - own) ** 2 - (noise + np.minimum(noise, spreads))
    d = np.minimum(above / (bandwidth**2 * (noise + spreads) + kernel.epsilon), kernel.cap)
    weights = np.exp(-np.maximum(0, d.mean((0, 3, 4))))
    inner = image[:, y - window : y + window + 1, x - window : x + window + 1]
    return np.asarray((weights * inner).sum((1, 2)) / weights.sum(), np.float32)
