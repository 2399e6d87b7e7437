"""NFOR as its authors' public implementation does it, written down literally in float64.

Pivoted QR per window, whole windows predicted one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from tests.models.plain_nlm import Array, nlm, patch_distance, weight, window

FLOAT32 = 2.0**-23
"""Its epsilon."""


@dataclass(frozen=True)
class Radii:
    """Window and patch radii; the published ones by default."""

    window: int = 9
    patch: int = 3
    prefilter: int = 5
    final: int = 2
    map_patch: int = 1


@dataclass
class Steps:
    """What every step returns, (H, W, C)."""

    features_a: Array
    features_b: Array
    filtered_a: list[Array]
    filtered_b: list[Array]
    errors: list[Array]
    selection: Array
    halves: tuple[Array, Array]
    features: Array
    color: Array


def least_squares(design: Array, target: Array, weights: Array) -> Array:
    """Return the basic solution of a column-pivoted QR.

    The public implementation's solver works in float32 and stops at the first column whose remaining norm is
    below epsilon times the largest norm, but for the number of rows that are left.
    """
    root = np.sqrt(weights)[:, None]
    q, r, order = scipy.linalg.qr(design * root, mode="economic", pivoting=True)
    diagonal, rows = np.abs(np.diag(r)), len(design)
    left = np.sqrt((rows - np.arange(len(diagonal))) / rows)
    rank = len(np.trim_zeros(np.cumprod(diagonal >= FLOAT32 * diagonal[0] * left)))
    solution = np.zeros((design.shape[1], target.shape[1]))
    right = q[:, :rank].T @ (target * root)
    solution[order[:rank]] = scipy.linalg.solve_triangular(r[:rank, :rank], right)
    return solution


def regression_weights(guide: Array, variance: Array, radii: Radii, k: float, scale: float) -> Array:
    """Return (offsets, H, W): the smallest channel weight towards every offset."""
    source = (guide, scale * variance)
    result = []
    for offset in window(radii.window):
        distance, there = patch_distance(source, source, offset, radii.patch, k)
        result.append(weight(distance, there, offset).min(-1))
    return np.stack(result)


def collaborative_regression(image: Array, features: Array, weights: Array, radius: int) -> Array:
    height, width = image.shape[:2]
    total, norm = np.zeros_like(image), np.zeros((height, width, 1))
    for y in range(height):
        for x in range(width):
            places, chosen = [], []
            for index, (down, right) in enumerate(window(radius)):
                if 0 <= y + down < height and 0 <= x + right < width:
                    places.append((y + down, x + right))
                    chosen.append(weights[index, y, x])
            rows, columns = np.array(places).T
            w = np.array(chosen)
            design = np.column_stack(
                [np.ones(len(w)), columns - x, rows - y, features[rows, columns] - features[y, x]]
            )
            solution = least_squares(design, image[rows, columns], w)
            total[rows, columns] += w[:, None] * (design @ solution)
            norm[rows, columns] += w[:, None]
    return total / norm


def error_estimate(a: Array, b: Array, filtered_a: Array, filtered_b: Array, variance: Array) -> Array:
    first = (b - filtered_a) ** 2 - 2 * variance
    second = (a - filtered_b) ** 2 - 2 * variance
    return 0.5 * (first + second) - 0.25 * (filtered_b - filtered_a) ** 2


def nfor(
    a: Array, b: Array, variance: Array, features: tuple[Array, Array, Array], radii: Radii | None = None
) -> Steps:
    """Run all steps.

    Args:
        a: First half (H, W, 3).
        b: Second half.
        variance: Of the mean of both.
        features: Halves a and b, and variance of the mean of both, (H, W, K) each.
        radii: The published ones by default.
    """
    radii = radii or Radii()
    mean, (fa, fb, fv) = (a + b) / 2, features
    filtered_fa = nlm(fa, fb, fv, radii.patch, radii.prefilter, 0.5, 2)
    filtered_fb = nlm(fb, fa, fv, radii.patch, radii.prefilter, 0.5, 2)
    outputs_a, outputs_b, errors = [], [], []
    for k in (0.5, 1.0):
        from_b = regression_weights(b, variance, radii, k, 2)
        from_a = regression_weights(a, variance, radii, k, 2)
        outputs_a.append(collaborative_regression(a, filtered_fb, from_b, radii.window))
        outputs_b.append(collaborative_regression(b, filtered_fa, from_a, radii.window))
        error = error_estimate(a, b, outputs_a[-1], outputs_b[-1], variance)
        errors.append(nlm(error, mean, variance, radii.map_patch, radii.window, 1.0, 1))
    binary = np.where(errors[0] < errors[1], 0.0, 1.0)
    t = nlm(binary, mean, variance, radii.map_patch, radii.window, 1.0, 1)
    half_a = (1 - t) * outputs_a[0] + t * outputs_a[1]
    half_b = (1 - t) * outputs_b[0] + t * outputs_b[1]
    middle = (filtered_fa + filtered_fb) / 2
    residual = (filtered_fb - filtered_fa) ** 2 / 4
    final = nlm(middle, middle, residual, radii.patch, radii.final, 0.5, 1)
    image = (half_a + half_b) / 2
    weights = regression_weights(image, (half_b - half_a) ** 2 / 4, radii, 1.0, 2)
    color = collaborative_regression(image, final, weights, radii.window)
    return Steps(filtered_fa, filtered_fb, outputs_a, outputs_b, errors, t, (half_a, half_b), final, color)
