"""Where things are: resting, stacked or floating, none in a wall, few in each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from data.render.implicit import random_turn
from data.render.spec import Mesh
from data.render.surfaces import affine, rotation, transformed

Floats = NDArray[np.float64]
Rng = np.random.Generator


class Surroundings(Protocol):
    """The room or the ground."""

    def clearance(self, points: Floats, floor: bool = True) -> Floats:
        """Return a lower bound of the distance from points (N, 3) to it; negative: in a wall or below."""

    def floor(self, ground: Floats) -> Floats:
        """Return the height on which things rest at points (N, 2) of x and z."""


@dataclass(frozen=True)
class Region:
    """Where things are put.

    Attributes:
        low: Corner (2,) in x and z.
        high: Corner (2,) in x and z.
        gathered: The middle is preferred.
        top: Largest height at which things float.
        scales: Smallest and largest radius.
    """

    low: Floats
    high: Floats
    gathered: bool
    top: float
    scales: tuple[float, float]

    def draw(self, rng: Rng) -> Floats:
        """Return a point (2,) of x and z."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        if self.gathered:
            return np.clip(middle + rng.normal(0, 0.45, 2) * half, self.low, self.high)
        return middle + rng.uniform(-1, 1, 2) * half


@dataclass
class Layout:
    """Bounding spheres of the things that have been placed.

    Attributes:
        centres: (N, 3).
        radii: (N,).
        tops: Highest point of each.
    """

    centres: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    radii: Floats = field(default_factory=lambda: np.zeros(0))
    tops: Floats = field(default_factory=lambda: np.zeros(0))

    def overlap(self, centre: Floats, radius: float, besides: int = -1) -> float:
        """Return how deep a sphere is in the others, as a share of the smaller radius; negative: free."""
        if not len(self.radii):
            return -1.0
        gap = np.linalg.norm(self.centres - centre, axis=1) - self.radii - radius
        share = -gap / np.minimum(self.radii, radius)
        if besides >= 0:
            share[besides] = -1.0
        return float(share.max())

    def add(self, mesh: Mesh) -> None:
        """Note a mesh that has been placed."""
        low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
        centre = (low + high) / 2
        radius = float(np.linalg.norm(mesh.vertices - centre, axis=1).max())
        self.centres = np.concatenate([self.centres, centre[None]])
        self.radii = np.append(self.radii, radius)
        self.tops = np.append(self.tops, high[1])


def place(rng: Rng, mesh: Mesh, region: Region, around: Surroundings, layout: Layout) -> Mesh:
    """Return a mesh of the unit ball scaled, turned and put at a free place, and note it in the layout.

    Where nothing is free the thing becomes smaller, until it fits.
    """
    low, high = np.log(region.scales)
    scale = float(np.exp(rng.uniform(low, high)))
    turn = rotation(np.array([0.0, 1.0, 0.0]), rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.45:
        turn = random_turn(rng)
    shape = turn @ np.diag(np.exp(rng.uniform(-0.25, 0.0, 3)))
    mode = rng.choice(["rest", "stack", "float"], p=[0.68, 0.14, 0.18])
    probe = mesh.vertices[:: max(1, len(mesh.vertices) // 150)].astype(np.float64) @ shape.T
    lowest = float((mesh.vertices @ shape[1]).min())
    best, worst = np.zeros(3), np.inf
    for attempt in range(60):
        offset, besides = _candidate(rng, mode, region, around, layout, lowest * scale)
        overlap = layout.overlap(offset, scale * 0.8, besides)
        wall = float(around.clearance(probe * scale + offset, floor=False).min())
        cost = max(overlap, 0.0) + 20 * max(0.02 - wall, 0.0)
        if cost < worst:
            best, worst = offset, cost
        if cost <= 0.1 + 0.01 * attempt:
            break
        if attempt % 6 == 5:
            scale *= 0.85
            worst = np.inf
    placed = transformed(mesh, affine(shape * scale, best))
    layout.add(placed)
    return placed


def _candidate(
    rng: Rng, mode: str, region: Region, around: Surroundings, layout: Layout, lowest: float
) -> tuple[Floats, int]:
    """Return a position (3,) and the number of the thing that is rested on, -1 if none."""
    if mode == "stack" and len(layout.radii):
        under = int(rng.integers(len(layout.radii)))
        x, z = layout.centres[under][[0, 2]] + rng.normal(0, 0.12, 2) * layout.radii[under]
        return np.array([x, layout.tops[under] - lowest - 0.03 * layout.radii[under], z]), under
    ground = region.draw(rng)
    floor = float(around.floor(ground[None])[0])
    rise = rng.uniform(0.1, 1.0) * region.top if mode == "float" else 0.01 * lowest
    return np.array([ground[0], floor + rise - lowest, ground[1]]), -1
