"""LBF written down literally in float64, pixel by pixel, from the sheet of facts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tests.models.plain_nlm import Array, gradient, mirrored


class Noisy(NamedTuple):
    """Halves of an image (H, W, C), and the variance of their mean."""

    a: Array
    b: Array
    variance: Array

    @property
    def mean(self) -> Array:
        return np.asarray((self.a + self.b) / 2)


class Network(NamedTuple):
    """Weights and biases of both layers, and what the input is normalised by."""

    hidden: tuple[Array, Array]
    output: tuple[Array, Array]
    mean: Array
    deviation: Array


@dataclass(frozen=True)
class Numbers:
    """Radii and thresholds."""

    window: int = 27
    factor: float = 0.01
    least: float = 1e-4
    prefilter: tuple[int, int, int] = (5, 3, 2)
    variance_limit: float | None = 10.0
    spike_window: int = 27
    output_limit: float | None = 2.0
    scaled: bool = True
    spp: float = 32.0


class Steps(NamedTuple):
    statistics: Array
    scales: Array
    color: Array


def around(image: Array, y: int, x: int, radius: int) -> Iterator[tuple[int, int]]:
    """Yield the places of a square window that lie inside the image."""
    height, width = image.shape[:2]
    for row in range(max(0, y - radius), min(height, y + radius + 1)):
        for column in range(max(0, x - radius), min(width, x + radius + 1)):
            yield row, column


def everywhere(image: Array) -> Iterator[tuple[int, int]]:
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            yield y, x


def box(image: Array, radius: int) -> Array:
    """Mean over the part of each box that is inside."""
    result = np.zeros_like(image)
    for y, x in everywhere(image):
        result[y, x] = np.mean([image[q] for q in around(image, y, x, radius)], 0)
    return result


def scaled_variance(noisy: Noisy) -> Array:
    ratio = box((noisy.a - noisy.b) ** 2 / 4, 10) / (1e-10 + box(noisy.variance, 10))
    return np.asarray(noisy.variance * ratio)


def despiked(image: Array, radius: int, limit: float) -> Array:
    """Replace pixels that are far from the mean around them in any channel by medians of 3x3."""
    height, width = image.shape[:2]
    result = image.copy()
    for y, x in everywhere(image):
        near = np.array([image[q] for q in around(image, y, x, radius)])
        if (np.abs(image[y, x] - near.mean(0)) > limit * near.std(0)).any():
            rows = [min(max(y + i, 0), height - 1) for i in (-1, 0, 1)]
            columns = [min(max(x + i, 0), width - 1) for i in (-1, 0, 1)]
            result[y, x] = np.median([image[row, column] for row in rows for column in columns], 0)
    return result


def feature_filter(image: Array, variance: Array, radii: tuple[int, int, int]) -> tuple[Array, Array]:
    """Filter a group of channels and its variance with the same weights."""
    window, patch, smoothing = radii
    height, width = image.shape[:2]
    totals, norm = np.zeros((2, *image.shape)), np.zeros((height, width, 1))
    for down in range(-window, window + 1):
        for right in range(-window, window + 1):
            # Pixels whose neighbour at this offset is inside.
            pairs = [
                (y, x) for y, x in everywhere(image) if 0 <= y + down < height and 0 <= x + right < width
            ]
            d = {
                (y, x): np.mean(
                    (image[y, x] - image[y + down, x + right]) ** 2
                    / (1e-10 + variance[y, x] + variance[y + down, x + right])
                )
                for y, x in pairs
            }
            w = {p: math.exp(-np.mean([d[n] for n in around(image, *p, patch) if n in d])) for p in pairs}
            for y, x in pairs:
                smooth = np.mean([w[n] for n in around(image, y, x, smoothing) if n in w])
                totals[0, y, x] += smooth * image[y + down, x + right]
                totals[1, y, x] += smooth * variance[y + down, x + right]
                norm[y, x] += smooth
    return totals[0] / norm, totals[1] / norm


def noise(image: Array) -> Array:
    """Estimate noise from the diagonals of blocks of 8x8 pixels; (H, W, C)."""
    height, width, channels = image.shape

    def at(y: int, x: int) -> Array:
        return np.asarray(image[mirrored(y, height), mirrored(x, width)])

    def block(y: int, x: int) -> Array:
        haar = [
            np.abs(at(v, u) - at(v, u + 1) - at(v + 1, u) + at(v + 1, u + 1)) / 2
            for v in range(y - 4, y + 4, 2)
            for u in range(x - 4, x + 4, 2)
        ]
        assert len(haar) == 16
        return np.asarray(np.median(haar, 0) / 0.6745)

    blocks = np.array([[block(y, x) for x in range(width + 1)] for y in range(height + 1)])
    averaged = (blocks[:-1, :-1] + blocks[1:, :-1] + blocks[:-1, 1:] + blocks[1:, 1:]) / 4
    result = np.zeros((height, width, channels))
    for y, x in everywhere(image):
        result[y, x] = np.max([averaged[q] for q in around(image, y, x, 1)], 0)
    return result


def statistics(image: Array, variance: Array, unfiltered: Array) -> Array:
    """Return the 7 numbers of a group, (H, W, 7)."""
    result = np.zeros((*image.shape[:2], 7))
    result[..., 0] = noise(unfiltered).mean(-1)
    result[..., 6] = gradient(image).mean(-1)
    for y, x in everywhere(image):
        seven = np.array([image[q] for q in around(image, y, x, 3)])
        three = np.array([image[q] for q in around(image, y, x, 1)])
        result[y, x, 1] = image[y, x].mean()
        result[y, x, 2] = np.sqrt(variance[y, x]).mean()
        result[y, x, 3] = seven.mean(0).mean()
        result[y, x, 4] = seven.std(0).mean()
        result[y, x, 5] = np.abs(three - three.mean(0)).mean(0).mean()
    return result


def predicted(statistic: Array, network: Network) -> Array:
    seen = (statistic - network.mean) / (network.deviation + 1e-6)
    hidden = 1 / (1 + np.exp(-(network.hidden[0] @ seen + network.hidden[1])))
    output = network.output[0] @ hidden + network.output[1]
    return np.asarray(np.log(1 + np.exp(np.minimum(output, 10))))


def bilateral(
    color: Array,
    color_variance: Array,
    features: Sequence[tuple[Array, Array]],
    scales: Array,
    n: Numbers,
) -> Array:
    """Filter the colour with the scales of every pixel (H, W, 1 + groups)."""
    result = np.zeros_like(color)
    for y, x in everywhere(color):
        total, norm = np.zeros(3), 0.0
        for q in around(color, y, x, n.window):
            exponent = scales[y, x, 0] * ((q[0] - y) ** 2 + (q[1] - x) ** 2)
            spread = 1e-10 + color_variance[y, x] + color_variance[q]
            exponent += n.factor * np.sum((color[y, x] - color[q]) ** 2 / spread)
            for k, (f, v) in enumerate(features):
                exponent += scales[y, x, k + 1] * np.sum((f[y, x] - f[q]) ** 2 / np.maximum(n.least, v[y, x]))
            w = math.exp(-exponent)
            total, norm = total + w * color[q], norm + w
        result[y, x] = total / norm
    return result


def lbf(color: Noisy, features: Sequence[Noisy], network: Network, n: Numbers) -> Steps:
    """Run LBF on an exposed colour and features whose distances are relative already."""

    def variance(noisy: Noisy) -> Array:
        return scaled_variance(noisy) if n.scaled else noisy.variance

    filtered = [feature_filter(f.mean, variance(f), n.prefilter) for f in features]
    parts = [statistics(*group, f.mean) for group, f in zip(filtered, features, strict=True)]
    parts.append(np.full((*color.a.shape[:2], 1), 1 / n.spp))
    seen = np.concatenate(parts, -1)
    scales = np.array([[predicted(pixel, network) for pixel in row] for row in seen])
    calm = variance(color)
    if n.variance_limit is not None:
        calm = despiked(calm, n.spike_window, n.variance_limit)
    result = bilateral(color.mean, calm, filtered, scales, n)
    return Steps(seen, scales, despiked(result, 1, n.output_limit) if n.output_limit else result)
