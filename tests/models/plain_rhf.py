"""Ray histogram fusion written down literally in float64, patch by patch and bin by bin."""

from __future__ import annotations

import numpy as np

from tests.models import plain_pyramid
from tests.models.plain_nlm import Array

BINS, M, S = 20, 2.5, 2.0


def histogram(samples: Array, exposure: float = 1.0) -> Array:
    """Return (H, W, 3, 20) of samples (S, H, W, 3); one that is not finite does not count."""
    _, height, width, channels = samples.shape
    result = np.zeros((height, width, channels, BINS))
    for sample in samples:
        for y in range(height):
            for x in range(width):
                if not np.isfinite(sample[y, x]).all():
                    continue
                for c in range(channels):
                    v = min(max(float(sample[y, x, c]) * exposure, 0.0) ** (1 / 2.2) / M, S)
                    t = v * (BINS - 2)
                    low = int(t) if t < BINS - 2 else BINS - 2
                    fraction = t - low if t < BINS - 2 else (v - 1) / (S - 1)
                    result[y, x, c, low] += 1 - fraction
                    result[y, x, c, low + 1] += fraction
    return result


def distance(h: Array, p: tuple[int, int], q: tuple[int, int], radius: int) -> float:
    """Return the distance of the patches around p and q, h: (H, W, 3, 20)."""
    total, count = 0.0, 0
    for n in range(-radius, radius + 1):
        for m in range(-radius, radius + 1):
            a, b = h[p[0] + n, p[1] + m], h[q[0] + n, q[1] + m]
            number_a, number_b = a[0].sum(), b[0].sum()
            if number_a == 0 or number_b == 0:
                continue
            for c in range(h.shape[2]):
                for i in range(BINS):
                    if a[c, i] + b[c, i] > 1:
                        square = (number_b * a[c, i] - number_a * b[c, i]) ** 2
                        total += square / (number_a * number_b * (a[c, i] + b[c, i]))
                        count += 1
    return total / (count + 1e-4)


def one_scale(u: Array, h: Array, window: int, patch: int, kappa: float, nearest: int) -> Array:
    """Filter u (H, W, 3): write the mean of accepted patches as a whole patch, average what overlaps."""
    height, width, _ = u.shape
    total, number = np.zeros_like(u), np.zeros((height, width, 1))
    for y in range(height):
        for x in range(width):
            radius = min(patch, y, x, height - 1 - y, width - 1 - x)
            found = []
            for v in range(max(radius, y - window), min(height - radius, y + window + 1)):
                for w in range(max(radius, x - window), min(width - radius, x + window + 1)):
                    found.append((distance(h, (y, x), (v, w), radius), v, w))
            others = sorted(entry for entry in found if entry[1:] != (y, x))
            chosen = {entry[1:] for entry in found if entry[0] < kappa}
            chosen |= {entry[1:] for entry in others[:nearest]} | {(y, x)}
            side = slice(-radius, radius + 1)
            patches = [u[v + side.start : v + side.stop, w + side.start : w + side.stop] for v, w in chosen]
            rows, columns = slice(y - radius, y + radius + 1), slice(x - radius, x + radius + 1)
            total[rows, columns] += np.mean(patches, axis=0)
            number[rows, columns] += 1
    return np.asarray(total / number)


def rhf(
    u: Array, h: Array, scales: int = 2, window: int = 6, patch: int = 1, kappa: float = 0.8, nearest: int = 2
) -> Array:
    """Filter u (H, W, 3) with histograms (H, W, 3, 20) at several scales."""
    height, width, _ = u.shape
    side = 2 ** (scales - 1)
    padding = ((0, -height % side), (0, -width % side))
    u = np.pad(u, (*padding, (0, 0)), mode="edge")
    h = np.pad(h, (*padding, (0, 0), (0, 0)), mode="edge")

    def scale(u: Array, h: Array, left: int) -> Array:
        fine = one_scale(u, h, window, patch, kappa, nearest if left == scales else 0)
        if left == 1:
            return fine
        flat = h.reshape(*h.shape[:2], -1)
        small = 4 * plain_pyramid.coarser(flat).reshape(h.shape[0] // 2, h.shape[1] // 2, *h.shape[2:])
        coarse = scale(plain_pyramid.coarser(u), small, left - 1)
        return fine + plain_pyramid.finer(coarse) - plain_pyramid.finer(plain_pyramid.coarser(fine))

    return scale(u, h, scales)[:height, :width]
