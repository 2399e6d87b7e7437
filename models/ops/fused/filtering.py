"""Non-local means of images."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

import numpy as np
from numba import njit

from models.ops.fused.strips import OPTIONS, TILE, Array, Kernel, Rows, in_threads, padded
from models.ops.fused.weights import scratch_of, tile_weights


@njit(**OPTIONS)
def _gather(images, place, weights, total, norm):
    """Add the weights of a tile to norm, and the weighted neighbours to total."""
    t, y, x = place
    _, channels, rows, columns = weights.shape
    left = np.uintp(x)
    for c in range(channels):
        for i in range(rows):
            for j in range(columns):
                norm[c, i, j] += weights[0, c, i, j]
    for g in range(images.shape[1]):
        for c in range(images.shape[2]):
            own = c if channels > 1 else 0
            for i in range(rows):
                for j in range(np.uintp(columns)):
                    total[g, c, i, j] += weights[0, own, i, j] * images[t, g, c, y + i, left + j]


@njit(**OPTIONS)
def _filter_tile(images, source, place, rule, scratch, sums):
    """Sum a tile's weighted neighbours and weights; place: the frame, the tile's first row and column."""
    total, norm, weights = sums
    centre, top, left = place
    window, pad = rule[2], rule[2] + rule[3]
    total.fill(np.float32(0.0))
    norm.fill(np.float32(0.0))
    for t in range(images.shape[0]):
        for down in range(-window, window + 1):
            for right in range(-window, window + 1):
                tile_weights(source, (centre, t, top, left, down, right), rule, scratch, weights, 0)
                _gather(images, (t, top + pad + down, left + pad + right), weights, total, norm)


@njit(**OPTIONS)
def _write(sums, out, y, x):
    """Write the quotients of a tile to out (G, C, rows, W) at a place, as far as it reaches."""
    total, norm, _ = sums
    for g in range(total.shape[0]):
        for c in range(total.shape[1]):
            own = c if norm.shape[0] > 1 else 0
            for i in range(min(total.shape[2], out.shape[2] - y)):
                for j in range(min(total.shape[3], out.shape[3] - x)):
                    out[g, c, y + i, x + j] = total[g, c, i, j] / norm[own, i, j]


@njit(**OPTIONS)
def _filter_rows(images, source, task, rule, tile, out):
    """Filter a strip; task: the frame, the first row and the last but one; out: (G, C, rows, W)."""
    centre, start, stop = task
    rows, columns = tile
    channels = source[0].shape[1]
    own = channels if rule[4] == 0 else 1
    total = np.zeros((images.shape[1], images.shape[2], rows, columns), np.float32)
    sums = (total, np.zeros((own, rows, columns), np.float32), np.zeros((1, own, rows, columns), np.float32))
    scratch = scratch_of(channels, rule[3], tile)
    for top in range(start, stop, rows):
        for left in range(0, out.shape[3], columns):
            _filter_tile(images, source, (centre, top, left), rule, scratch, sums)
            _write(sums, out, top - start, left)


def filter_images(images: Array, guide: Array, variance: Array, kernel: Kernel, centre: int = 0) -> Array:
    """Filter images with the weights that a guide gives; see `models.ops.nlm.nlm_filter`.

    Args:
        images: (T, G, C, H, W).
        guide: (T, C, H, W).
        variance: Of the guide, scaled.
        kernel: How patches are compared.
        centre: Which frame is filtered.

    Returns:
        (G, C, H, W).
    """
    height, width = images.shape[-2:]
    out = np.empty((*images.shape[1:3], height, width), np.float32)
    images, source = padded(images, kernel), (padded(guide, kernel), padded(variance, kernel))
    rule = kernel.rule((height, width))

    def run(rows: Rows) -> Array:
        part = np.empty((*out.shape[:2], rows[1] - rows[0], width), np.float32)
        _filter_rows(images, source, (centre, *rows), rule, TILE, part)
        return part

    for (start, stop), part in in_threads(run, height, kernel.threads):
        out[:, :, start:stop] = part
    return out
