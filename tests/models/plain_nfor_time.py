"""The space-time mode of NFOR written down literally in float64: windows over frames, patches within one.

Beside `plain_nfor` only the regression differs: the window holds the frames around a pixel's own as far as
they exist, and the frame index is a regressor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tests.models.plain_nfor import Radii, error_estimate, least_squares
from tests.models.plain_nlm import Array, nlm, patch_distance, weight, window

Place = tuple[int, int, int]


def neighbours(count: int, frame: int, reach: int) -> list[int]:
    return [t for t in range(frame - reach, frame + reach + 1) if 0 <= t < count]


def weights_between(
    guides: Sequence[tuple[Array, Array]], frame: int, other: int, radii: Radii, k: float
) -> dict[tuple[int, int], Array]:
    """Return for every offset the weight (H, W) from a frame's pixels to those of another."""
    found = {}
    for offset in window(radii.window):
        distance, there = patch_distance(guides[frame], guides[other], offset, radii.patch, k)
        # A pixel's own weight has a floor; one in another frame is a neighbour like all others.
        own = offset if other == frame else (9999, 9999)
        found[offset] = weight(distance, there, own).min(-1)
    return found


def regression(
    images: Array, features: Array, guides: Sequence[tuple[Array, Array]], radii: Radii, k: float, reach: int
) -> Array:
    """Fit and predict windows over frames; images (T, H, W, 3), features (T, H, W, K)."""
    count, height, width = images.shape[:3]
    total, norm = np.zeros_like(images), np.zeros((*images.shape[:3], 1))
    for frame in range(count):
        near = neighbours(count, frame, reach)
        weights = {t: weights_between(guides, frame, t, radii, k) for t in near}
        for y in range(height):
            for x in range(width):
                places: list[Place] = []
                chosen, rows = [], []
                for t in near:
                    for down, right in window(radii.window):
                        if 0 <= y + down < height and 0 <= x + right < width:
                            q = (t, y + down, x + right)
                            places.append(q)
                            chosen.append(weights[t][down, right][y, x])
                            slopes = features[q] - features[frame, y, x]
                            rows.append([1, right, down, t - frame, *slopes])
                w, design, at = np.array(chosen), np.array(rows, float), tuple(np.array(places).T)
                solution = least_squares(design, images[at], w)
                total[at] += w[:, None] * (design @ solution)
                norm[at] += w[:, None]
    return total / norm


def nfor(
    a: Array, b: Array, variance: Array, features: tuple[Array, Array, Array], radii: Radii, reach: int
) -> Array:
    """Run all steps on sequences (T, H, W, C) and return all frames."""
    fa, fb, fv = features
    each = range(len(a))
    mean = (a + b) / 2
    filtered_fa = np.stack([nlm(fa[t], fb[t], fv[t], radii.patch, radii.prefilter, 0.5, 2) for t in each])
    filtered_fb = np.stack([nlm(fb[t], fa[t], fv[t], radii.patch, radii.prefilter, 0.5, 2) for t in each])
    outputs_a, outputs_b, errors = [], [], []

    def mapped(image: Array) -> Array:
        maps = [nlm(image[t], mean[t], variance[t], radii.map_patch, radii.window, 1.0, 1) for t in each]
        return np.stack(maps)

    for k in (0.5, 1.0):
        from_b, from_a = (list(zip(half, 2 * variance, strict=True)) for half in (b, a))
        outputs_a.append(regression(a, filtered_fb, from_b, radii, k, reach))
        outputs_b.append(regression(b, filtered_fa, from_a, radii, k, reach))
        errors.append(mapped(error_estimate(a, b, outputs_a[-1], outputs_b[-1], variance)))
    t = mapped(np.where(errors[0] < errors[1], 0.0, 1.0))
    half_a = (1 - t) * outputs_a[0] + t * outputs_a[1]
    half_b = (1 - t) * outputs_b[0] + t * outputs_b[1]
    middle, residual = (filtered_fa + filtered_fb) / 2, (filtered_fb - filtered_fa) ** 2 / 4
    final = np.stack([nlm(middle[t], middle[t], residual[t], radii.patch, radii.final, 0.5, 1) for t in each])
    image, left = (half_a + half_b) / 2, (half_b - half_a) ** 2 / 4
    return regression(image, final, list(zip(image, 2 * left, strict=True)), radii, 1.0, reach)
