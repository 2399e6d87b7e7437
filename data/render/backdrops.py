"""Grounds of outdoor scenes: rolling land, a hollow, a studio sweep; finely meshed in the middle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.render.noise import SpaceNoise
from data.render.spec import Mesh
from data.render.surfaces import grid_mesh

Floats = NDArray[np.float64]
Rng = np.random.Generator

EXTENT = 60.0
"""Half edge of the ground."""


@dataclass(frozen=True)
class Backdrop:
    """A ground.

    Attributes:
        kind: `land`, `hollow` or `sweep`.
        mesh: Its mesh, front up.
        height: Points (N, 2) of x and z → height.
        facing: Direction towards the open side of a sweep (3,), None where all sides are open.
    """

    kind: str
    mesh: Mesh
    height: Callable[[Floats], Floats]
    facing: Floats | None = None

    def clearance(self, points: Floats, floor: bool = True) -> Floats:
        """Return a lower bound of the distance from points (N, 3) to the ground; negative: below it.

        Args:
            points: Positions.
            floor: The ground counts; otherwise nothing is near.
        """
        if not floor:
            return np.full(len(points), 1e3)
        slope = 0.2 if self.facing is not None else 0.5
        return slope * (points[:, 1] - self.height(points[:, [0, 2]]))

    def floor(self, ground: Floats) -> Floats:
        """Return the height on which things rest at points (N, 2) of x and z."""
        return self.height(ground)


def _land(rng: Rng, hollow: bool) -> Callable[[Floats], Floats]:
    noise = SpaceNoise(rng)
    rough = rng.choice([0.0, 0.05, 0.15, 0.3], p=[0.3, 0.3, 0.25, 0.15])
    scale, hills = rng.uniform(0.3, 1.2), rng.uniform(0, 6) * (rng.random() < 0.6)
    rise = rng.uniform(3, 10) if hollow else 0.0

    def height(ground: Floats) -> Floats:
        points = np.stack([ground[:, 0], np.zeros(len(ground)), ground[:, 1]], 1)
        far = np.hypot(ground[:, 0], ground[:, 1])
        away = np.clip((far - 9) / 25, 0, 1) ** 2
        near = rough * noise.fbm(points * scale + 40, 4)
        return near + away * (rise + hills * (0.3 + noise.fbm(points * 0.08 + 8, 4)))

    return height


def _sweep(rng: Rng, turn: float) -> Callable[[Floats], Floats]:
    """A floor that bends up into a wall behind the scene, looking along `turn`."""
    noise, bump = SpaceNoise(rng), rng.choice([0.0, 0.0, 0.02])
    back, radius, wall = rng.uniform(5.0, 9.0), rng.uniform(1.5, 4.0), rng.uniform(0.0, 8.0)

    def height(ground: Floats) -> Floats:
        behind = -(ground[:, 0] * np.sin(turn) + ground[:, 1] * np.cos(turn)) - back
        inside = np.clip(behind, 0, 0.98 * radius)
        bend = radius - np.sqrt(radius**2 - inside**2)
        steep = np.clip(behind - 0.98 * radius, 0, None) * 5
        points = np.stack([ground[:, 0], np.zeros(len(ground)), ground[:, 1]], 1)
        return bend + np.minimum(steep, wall) + bump * noise.fbm(points * 3 + 90, 3)

    return height


def random_backdrop(rng: Rng) -> Backdrop:
    """Return a ground of 120 x 120 units, flat enough near the middle for things to lie on."""
    kind = str(rng.choice(["land", "hollow", "sweep"], p=[0.45, 0.25, 0.3]))
    turn = float(rng.uniform(0, 2 * np.pi))
    facing = np.array([np.sin(turn), 0.0, np.cos(turn)]) if kind == "sweep" else None
    height = _sweep(rng, turn) if kind == "sweep" else _land(rng, kind == "hollow")
    count = 128
    t = np.linspace(-1, 1, count + 1)
    # Half of the vertices lie within 12 units of the middle, where the camera and the objects are.
    axis = np.sign(t) * (14 * np.abs(t) + (EXTENT - 14) * np.abs(t) ** 5)
    z, x = np.meshgrid(axis, axis, indexing="ij")
    ground = np.stack([x.ravel(), z.ravel()], 1)
    if kind == "sweep":  # the rows of the mesh run along the bend
        c, s = np.cos(turn), np.sin(turn)
        ground = ground @ np.array([[c, -s], [s, c]])
    y = height(ground)
    points = np.stack([ground[:, 0], y, ground[:, 1]], 1).reshape(count + 1, count + 1, 3)
    mesh = grid_mesh(points)
    uvs = np.stack([ground[:, 0], ground[:, 1] - y], 1) * rng.uniform(0.1, 0.6)
    return Backdrop(
        kind, Mesh(mesh.vertices, mesh.faces, mesh.normals, uvs.astype(np.float32)), height, facing
    )
