"""Non-local means of images."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.ops.fused.strips import INNER, OPTIONS, Array, Kernel, Rows, in_threads, padded, tiles
from models.ops.fused.weights import exponential, scratch_of, tile_weights

TILE = (32, 256)
"""Rows and columns: so large that patch margins take a fifth of the time."""


@dataclass(frozen=True)
class FeatureMaps:
    """Features that weights also look at, see `models.ops.joint`.

    Attributes:
        maps: Images, their variances, and t, (3, K, H, W).
        starts: First channel of every feature, and K.
        numbers: k^2, epsilon, and 1 where weights are multiplied, 0 where the smallest counts.
    """

    maps: Array
    starts: NDArray[np.int64]
    numbers: Array


_NONE = FeatureMaps(np.zeros((3, 0, 1, 1), np.float32), np.zeros(1, np.int64), np.zeros(3, np.float32))


@njit(**INNER)
def _join(features, place, scratch, weights, i):
    """Combine a row of weights with those of the features; place: rows and columns of both pixels."""
    maps, starts, numbers = features
    each, joined = scratch[0], scratch[2]
    y, z, x, w = place
    product, columns = numbers[2], np.uintp(weights.shape[3])
    for j in range(columns):
        joined[j] = np.float32(0.0)
    for n in range(starts.shape[0] - 1):
        for j in range(columns):
            each[j] = np.float32(0.0)
        for c in range(starts[n], starts[n + 1]):
            for j in range(columns):
                f = maps[0, c, y, x + j] - maps[0, c, z, w + j]
                v, r = maps[1, c, y, x + j], maps[1, c, z, w + j]
                spread = maps[2, c, y, x + j] + maps[2, c, z, w + j]
                each[j] += (f * f - (v + min(v, r))) / (numbers[1] + numbers[0] * spread)
        share = np.float32(1.0) / np.float32(starts[n + 1] - starts[n])
        for j in range(columns):
            d = max(np.float32(0.0), each[j] * share)
            # The largest, or the sum: that is the larger and the smaller.
            joined[j] = max(joined[j], d) + product * min(joined[j], d)
    for j in range(columns):
        own, other = weights[0, 0, i, j], exponential(joined[j])
        weights[0, 0, i, j] = product * own * other + (np.float32(1.0) - product) * min(own, other)


@njit(**OPTIONS)
def _filter_tile(images, source, features, place, rule, scratch, sums):
    """Sum a tile's weighted neighbours and weights; place: the frame, the tile's first row and column."""
    total, norm, weights = sums
    centre, top, left = place
    channels, columns = norm.shape[0], np.uintp(norm.shape[2])
    window, pad, joint = rule[2], rule[2] + rule[3], features[1].shape[0] > 1
    for t in range(images.shape[0]):
        for index in range((2 * window + 1) * (2 * window + 1)):
            down, right = index // (2 * window + 1) - window, index % (2 * window + 1) - window
            tile_weights(source, (centre, t, top, left, down, right), rule, scratch, weights, 0)
            y, x = top + pad + down, np.uintp(left + pad + right)
            for i in range(norm.shape[1]):
                if joint:
                    _join(features, (top + pad + i, y + i, np.uintp(left + pad), x), scratch, weights, i)
                for c in range(channels):
                    for j in range(columns):
                        norm[c, i, j] += weights[0, c, i, j]
                for g in range(images.shape[1]):
                    for c in range(images.shape[2]):
                        own = min(c, channels - 1)
                        for j in range(columns):
                            total[g, c, i, j] += weights[0, own, i, j] * images[t, g, c, y + i, x + j]


def filter_images(
    images: Array,
    guide: Array,
    variance: Array,
    kernel: Kernel,
    centre: int = 0,
    features: FeatureMaps = _NONE,
) -> Array:
    """Filter images with the weights that a guide gives; see `models.ops.nlm.nlm_filter`.

    Args:
        images: (T, G, C, H, W).
        guide: (T, C, H, W).
        variance: Of the guide, scaled.
        kernel: How patches are compared.
        centre: Which frame is filtered.
        features: What weights also look at, for kernels with one weight for all channels and one frame.

    Returns:
        (G, C, H, W).
    """
    height, width = images.shape[-2:]
    out = np.empty((*images.shape[1:3], height, width), np.float32)
    images, source = padded(images, kernel), (padded(guide, kernel), padded(variance, kernel))
    rule = kernel.rule((height, width))
    joined = (padded(features.maps, kernel), features.starts, features.numbers)
    own = guide.shape[1] if kernel.channels == "own" else 1

    def run(rows: Rows) -> None:
        for top, left, tile in tiles(rows, width, TILE):
            total, norm = np.zeros((*out.shape[:2], *tile), np.float32), np.zeros((own, *tile), np.float32)
            sums = (total, norm, np.zeros((1, *norm.shape), np.float32))
            scratch = scratch_of(kernel.patch, tile)
            _filter_tile(images, source, joined, (centre, top, left), rule, scratch, sums)
            out[..., top : top + tile[0], left : left + tile[1]] = total / norm

    for _ in in_threads(run, height, kernel.threads):
        pass
    return out
