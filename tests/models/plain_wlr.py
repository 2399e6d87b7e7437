"""WLR written down literally in float64, pixel by pixel, from the description of its authors' code."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]

TRIALS = (0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass
class Scene:
    """Images (H, W, C); every feature is one scaled vector."""

    color: Array
    color_variance: Array
    features: list[Array]
    variances: list[Array]
    radius: int = 9

    @property
    def grey_variance(self) -> Array:
        return self.color_variance.mean(-1)


@dataclass
class Reduced:
    """The neighbours of a pixel, their coordinates (N, rank), and which of them is the pixel."""

    places: list[tuple[int, int]]
    coordinates: Array
    own: int


@dataclass
class Steps:
    """What every step returns."""

    rank: Array
    first: Array
    bandwidth: Array
    color: Array
    shapes: dict[tuple[int, int], Array] = field(default_factory=dict)


def neighbours(scene: Scene, y: int, x: int) -> list[tuple[int, int]]:
    height, width = scene.color.shape[:2]
    return [
        (v, u)
        for v in range(max(0, y - scene.radius), min(height, y + scene.radius + 1))
        for u in range(max(0, x - scene.radius), min(width, x + scene.radius + 1))
    ]


def reduce(scene: Scene, y: int, x: int) -> Reduced:
    places = neighbours(scene, y, x)
    own = places.index((y, x))
    position = np.array([[u - x, v - y] for v, u in places], dtype=float)
    columns, scales, noise = [position], [float(scene.radius)] * 2, 0.0
    for image, variance in zip(scene.features, scene.variances, strict=True):
        values = np.array([image[place] - image[y, x] for place in places])
        deviation = values - values.mean(0)
        scale = max(0.01, max(math.sqrt((row**2).sum()) for row in deviation))
        noise += sum(float(np.clip(variance[place], 0, 1).sum()) for place in places) / scale**2
        columns.append(values)
        scales += [scale] * image.shape[-1]
    matrix = np.concatenate(columns, 1)
    deviations, size = matrix - matrix.mean(0), matrix.shape[1]
    values, vectors = np.linalg.eigh(deviations.T @ deviations / np.outer(scales, scales))
    norm = math.sqrt(noise) / (0.5 * math.sqrt(size))
    singular = np.sqrt(np.maximum(values, 0))
    kept = [i for i in range(size) if singular[i] > 0.01 + 2 * norm or i >= size - 2]
    return Reduced(places, (matrix / scales) @ vectors[:, kept], own)


def kernel(coordinates: Array, bandwidths: Array) -> Array:
    weights = np.ones(len(coordinates))
    for n, row in enumerate(coordinates):
        for t, b in zip(row, bandwidths, strict=True):
            weights[n] *= 0.75 * (1 - (t / b) ** 2) if abs(t) < b else 0.0
    return weights


def ridge_matrix(size: int, ridge: float) -> Array:
    return np.diag([0.0] + [ridge] * (size - 1))


def bandwidths(scene: Scene, reduced: Reduced) -> Array:
    rank = reduced.coordinates.shape[1]
    weights = kernel(reduced.coordinates, np.ones(rank))
    design = np.column_stack([np.ones(len(weights)), reduced.coordinates, reduced.coordinates**2])
    colors = np.array([scene.color[place] for place in reduced.places])
    normal = design.T @ (weights[:, None] * design) + ridge_matrix(1 + 2 * rank, 1e-3)
    solution = np.linalg.solve(normal, design.T @ (weights[:, None] * colors))
    curvature = (2 * np.abs(solution[1 + rank :])).mean(1)
    return np.asarray(1 / np.sqrt(curvature + 0.16))


def fit(scene: Scene, reduced: Reduced, bandwidth: Array) -> tuple[Array, float]:
    """Return the value of the linear fit at the pixel and its variance."""
    own = reduced.places[reduced.own]
    weights = kernel(reduced.coordinates, bandwidth)
    for n, place in enumerate(reduced.places):
        spread = math.sqrt(scene.grey_variance[own]) + math.sqrt(scene.grey_variance[place])
        if abs(scene.color[own].mean() - scene.color[place].mean()) > 3 * spread + 0.005:
            weights[n] = 0.0
        weights[n] /= max(1.0, scene.grey_variance[place])
    if (weights > 0).sum() <= 1:
        return scene.color[own], float(scene.grey_variance[own])
    design = np.column_stack([np.ones(len(weights)), reduced.coordinates])
    normal = design.T @ (weights[:, None] * design) + ridge_matrix(design.shape[1], 1e-4)
    row = np.linalg.inv(normal)[0] @ (design * weights[:, None]).T
    colors = np.array([scene.color[place] for place in reduced.places])
    if (row @ colors < 0).any():
        row = np.maximum(row, 0) / np.maximum(row, 0).sum()
    variances = np.array([scene.grey_variance[place] for place in reduced.places])
    return row @ colors, float((row**2 * variances).sum())


def shared(trials: tuple[float, ...], bias: list[float], variance: list[float], rank: int) -> float:
    """Return the shared bandwidth; both lines are fitted by least squares."""
    h = np.array(trials)
    a1 = np.linalg.lstsq(np.column_stack([np.ones(len(h)), h**2]), np.array(bias) - bias[0], rcond=None)[0][1]
    inverse = h ** float(-rank)
    design = np.column_stack([np.ones(len(h)), inverse / inverse.max()])
    c1 = np.linalg.lstsq(design, np.array(variance) - variance[0], rcond=None)[0][1] / inverse.max()
    if c1 <= 0:
        return 0.01
    if a1 == 0:
        return 1.0
    return float(np.clip((rank * c1 / (4 * a1**2)) ** (1 / (rank + 4)), 0.01, 1))


def gaussian(image: Array) -> Array:
    result = np.zeros_like(image)
    for y, x in np.ndindex(*image.shape):
        total = norm = 0.0
        for v in range(max(0, y - 3), min(image.shape[0], y + 4)):
            for u in range(max(0, x - 3), min(image.shape[1], x + 4)):
                weight = math.exp(-0.5 * ((v - y) ** 2 + (u - x) ** 2))
                total, norm = total + weight * image[v, u], norm + weight
        result[y, x] = total / norm
    return result


def wlr(scene: Scene) -> Steps:
    """Run all steps on every pixel."""
    size = scene.color.shape[:2]
    steps = Steps(np.zeros(size), np.zeros(size), np.zeros(size), np.zeros((*size, 3)))
    spaces = {}
    for y, x in np.ndindex(*size):
        reduced = spaces[y, x] = reduce(scene, y, x)
        shape = steps.shapes[y, x] = bandwidths(scene, reduced)
        found = [fit(scene, reduced, h * shape) for h in TRIALS]
        bias = [float((value - scene.color[y, x]).mean()) for value, _ in found]
        steps.rank[y, x] = len(shape)
        steps.first[y, x] = shared(TRIALS, bias, [variance for _, variance in found], len(shape))
    steps.bandwidth = gaussian(steps.first)
    for (y, x), reduced in spaces.items():
        steps.color[y, x] = fit(scene, reduced, steps.bandwidth[y, x] * steps.shapes[y, x])[0]
    return steps
