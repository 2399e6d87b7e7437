"""A sketch of a scene, bounding spheres in their surroundings, that rays meet; the geometry of cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.render.placement import Layout, Surroundings
from data.render.spec import View
from data.render.surfaces import affine, rotation, unit

Floats = NDArray[np.float64]

SHRUNK = 0.7
"""Most things fill about this part of their bounding spheres' radius."""

FAR = 80.0


@dataclass(frozen=True)
class Seen:
    """What a view shows in the sketch.

    Attributes:
        distance: Along each ray (N,), inf: nothing.
        thing: Number of the thing that each ray meets (N,), -1: the surroundings or nothing.
        directions: Of the rays (N, 3).
    """

    distance: Floats
    thing: NDArray[np.int64]
    directions: Floats


@dataclass(frozen=True)
class Sketch:
    """A scene as its bounding spheres and its surroundings.

    Attributes:
        layout: The spheres.
        around: Room or ground.
        things: How many of the spheres, the first ones, are objects; the rest are lights.
        region: Low and high corner (3,) of where a camera may be; None: anywhere around the objects.
        facing: Direction of the side from which the scene is seen (3,); None: from all.
    """

    layout: Layout
    around: Surroundings
    things: int
    region: tuple[Floats, Floats] | None = None
    facing: Floats | None = None

    def free(self, points: Floats, shift: Floats | None = None) -> Floats:
        """Return the distance from points (N, 3) to everything.

        Args:
            points: Positions.
            shift: Displacement of each thing at each point (N, K, 3).
        """
        centres = self.layout.centres[None] + (0 if shift is None else shift)
        near = np.linalg.norm(points[:, None] - centres, axis=2) - self.layout.radii
        return np.minimum(near.min(1, initial=np.inf), self.around.clearance(points))

    def trace(self, origin: Floats, directions: Floats, shrunk: float = SHRUNK) -> Seen:
        """Return what rays from a point (3,) along directions (N, 3) meet."""
        away = self.layout.centres - origin
        along = directions @ away.T
        squared = (away**2).sum(1) - along**2
        half = (self.layout.radii * shrunk) ** 2 - squared
        hit = (half > 0) & (along > 0)
        t = np.where(hit, along - np.sqrt(np.maximum(half, 0)), np.inf)
        thing = t.argmin(1)
        nearest = np.maximum(t.min(1), 1e-3)
        ground, going = np.full(len(directions), 0.05), np.arange(len(directions))
        for _ in range(32):
            step = self.around.clearance(origin + ground[going, None] * directions[going])
            ground[going] = np.minimum(ground[going] + np.maximum(step, 0.0), FAR)
            going = going[(step > 0.02) & (ground[going] < np.minimum(nearest[going], FAR))]
            if not len(going):
                break
        ground = np.where(ground >= FAR, np.inf, ground)
        thing = np.where(np.isfinite(nearest) & (nearest < ground), thing, -1)
        return Seen(np.minimum(nearest, ground), thing, directions)


def look_at(origin: Floats, target: Floats, roll: float = 0.0) -> Floats:
    """Return the camera matrix 4x4 of a camera that looks at a target: +Z ahead, +X to the left, +Y up."""
    ahead = unit(target - origin)
    left = unit(np.cross(np.array([0.0, 1.0, 0.0]), ahead))
    matrix = affine(np.stack([left, np.cross(ahead, left), ahead], 1), origin)
    matrix[:3, :3] = rotation(ahead, roll) @ matrix[:3, :3]
    return matrix


def focal(view: View) -> float:
    """Return the focal length in pixels."""
    return view.width / (2 * np.tan(np.radians(view.fov) / 2))


def rays(view: View, columns: int = 16) -> Floats:
    """Return the directions (N, 3) of a coarse grid of rays over the view."""
    rows = max(2, round(columns * view.height / view.width))
    x = (np.arange(columns) + 0.5) / columns * view.width - view.width / 2
    y = (np.arange(rows) + 0.5) / rows * view.height - view.height / 2
    local = np.stack([*np.meshgrid(-x / focal(view), -y / focal(view)), np.ones((rows, columns))], -1)
    return unit(local.reshape(-1, 3)) @ view.to_world[:3, :3].T


def project(view: View, points: Floats) -> Floats:
    """Return pixels (N, 2) of points (N, 3); those behind the camera become NaN."""
    local = (points - view.to_world[:3, 3]) @ view.to_world[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = -local[:, :2] / local[:, 2:] * focal(view) + [view.width / 2, view.height / 2]
    return np.where(local[:, 2:] > 1e-6, pixel, np.nan)
