"""Noise: periodic gradient and cell noise in the plane, value noise in space; all seeded and vectorised.

References: K. Perlin, Improving noise, SIGGRAPH 2002, DOI 10.1145/566570.566636 (gradient noise, quintic
fade); S. Worley, A cellular texture basis function, SIGGRAPH 1996, DOI 10.1145/237170.237267.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Floats = NDArray[np.float64]


def _fade(t: Floats) -> Floats:
    return t * t * t * (t * (t * 6 - 15) + 10)


def gradient_noise(rng: Rng, size: int, cells: int) -> Floats:
    """Return gradient noise (size, size) of `cells` lattice cells per side; it tiles; about [-1, 1]."""
    angle = rng.uniform(0, 2 * np.pi, (cells, cells))
    gx, gy = np.cos(angle), np.sin(angle)
    position = (np.arange(size) + 0.5) * cells / size
    low = position.astype(int)
    t = position - low
    low, high, fade = low % cells, (low + 1) % cells, _fade(t)

    # Separable: gradients are weighted along y first, while there are only `cells` columns of them.
    near, far = (1 - fade)[:, None], fade[:, None]
    x = gx[low] * near + gx[high] * far
    y = gy[low] * (near * t[:, None]) + gy[high] * (far * (t - 1)[:, None])
    left = x.take(low, 1) * t + y.take(low, 1)
    right = x.take(high, 1) * (t - 1) + y.take(high, 1)
    return (left + (right - left) * fade) * np.sqrt(2)


def fbm(rng: Rng, size: int, cells: int, octaves: int = 5, gain: float = 0.5) -> Floats:
    """Return a sum of octaves of gradient noise (size, size) that tiles, scaled to [-1, 1].

    Octaves whose cells would be smaller than two pixels are left out.
    """
    total = np.zeros((size, size))
    for octave in range(octaves):
        fine = cells << octave
        if fine * 2 > size and octave:
            break
        total += gain**octave * gradient_noise(rng, size, fine)
    return total / max(float(np.abs(total).max()), 1e-9)


@dataclass(frozen=True)
class Cells:
    """Cell noise of a picture.

    Attributes:
        nearest: Distance to the nearest point in lattice cells (size, size).
        second: Distance to the second nearest one.
        label: Number of the nearest point's cell (size, size).
    """

    nearest: Floats
    second: Floats
    label: NDArray[np.int64]


def cell_noise(rng: Rng, size: int, cells: int, jitter: float = 0.9) -> Cells:
    """Return the distances to one random point per lattice cell; the pattern tiles."""
    points = 0.5 + jitter * (rng.random((cells, cells, 2)) - 0.5)
    position = (np.arange(size) + 0.5) * cells / size
    low = position.astype(int)
    nearest = np.full((size, size), 9.0)
    second = np.full((size, size), 9.0)
    label = np.zeros((size, size), np.int64)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            rows, columns = np.ix_((low + dy) % cells, (low + dx) % cells)
            point = points[rows, columns]
            y = (low + dy - position)[:, None] + point[..., 0]
            x = (low + dx - position)[None, :] + point[..., 1]
            distance = np.hypot(x, y)
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            nearest = np.where(closer, distance, nearest)
            label = np.where(closer, rows * cells + columns, label)
    return Cells(nearest, second, label)


class SpaceNoise:
    """Value noise in space, of period 16."""

    def __init__(self, rng: Rng) -> None:
        self._table = rng.uniform(-1, 1, (16, 16, 16))

    def __call__(self, points: Floats) -> Floats:
        """Return the noise at points (N, 3): (N,), within [-1, 1]."""
        low = np.floor(points).astype(int)
        tx, ty, tz = _fade(points - low).T
        x0, y0, z0 = (low % 16).T * np.array([[256], [16], [1]])
        x1, y1, z1 = ((low + 1) % 16).T * np.array([[256], [16], [1]])
        table = self._table.reshape(-1)

        def row(y: NDArray[np.int64], z: NDArray[np.int64]) -> Floats:
            yz = y + z
            start = table.take(x0 + yz)
            return start + (table.take(x1 + yz) - start) * tx

        near, far = row(y0, z0), row(y0, z1)
        near += (row(y1, z0) - near) * ty
        far += (row(y1, z1) - far) * ty
        return near + (far - near) * tz

    def fbm(self, points: Floats, octaves: int = 4, gain: float = 0.5) -> Floats:
        """Return a sum of octaves at points (N, 3), within about [-1, 1]."""
        total = np.zeros(len(points))
        for octave in range(octaves):
            total += gain**octave * self(points * 2.0**octave + 5.37 * octave)
        return total * (1 - gain) / (1 - gain**octaves)
