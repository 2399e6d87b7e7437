"""Rooms: a plan, a ceiling, solids, openings to the outside, and the distance of points to all of them.

Walls have no thickness; openings have reveals, as if they had one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.render.spec import Mesh
from data.render.surfaces import box_uvs, flat, grid_faces, joined

Floats = NDArray[np.float64]
Rng = np.random.Generator
Ceiling = Callable[[Floats, Floats], Floats]
"""Coordinates x and z → height."""

WALL_STEPS = 16
SAFE = 0.7
"""Heights below a sloped ceiling times this are less than the distance to it, for slopes up to 45 degrees."""


@dataclass(frozen=True)
class Rect:
    """A rectangle of the plan, from (x0, z0) to (x1, z1)."""

    x0: float
    z0: float
    x1: float
    z1: float


@dataclass(frozen=True)
class Box:
    """A solid axis-aligned block in a room: low corner and high corner."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class Column:
    """A round pillar from floor to ceiling."""

    x: float
    z: float
    radius: float


@dataclass(frozen=True)
class Wall:
    """A wall from one point of the plan to another (2,) each; the room is on its left, seen from above."""

    start: Floats
    end: Floats


@dataclass
class Room:
    """A room.

    Attributes:
        kind: Its name in `ROOMS`.
        plan: Rectangles whose union is the floor.
        ceiling: Height over the plan.
        height: Largest height.
        boxes: Blocks in it; those that begin at the floor can be stood on.
        columns: Pillars in it.
        parts: Name → mesh, fronts towards the inside.
        walls: Its walls.
    """

    kind: str
    plan: list[Rect]
    ceiling: Ceiling
    height: float
    boxes: list[Box] = field(default_factory=list)
    columns: list[Column] = field(default_factory=list)
    parts: dict[str, Mesh] = field(default_factory=dict)
    walls: list[Wall] = field(default_factory=list)

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Low and high corner of the bounding box (3,) each."""
        x0, z0 = min(r.x0 for r in self.plan), min(r.z0 for r in self.plan)
        x1, z1 = max(r.x1 for r in self.plan), max(r.z1 for r in self.plan)
        return np.array([x0, 0.0, z0]), np.array([x1, self.height, z1])

    @property
    def area(self) -> float:
        """Area of floor, ceiling and walls."""
        floor = sum((r.x1 - r.x0) * (r.z1 - r.z0) for r in self.plan)
        around = sum(float(np.linalg.norm(w.end - w.start)) for w in self.walls)
        return 2 * floor + around * self.height

    def clearance(self, points: Floats, floor: bool = True) -> Floats:
        """Return a lower bound of the distance from points (N, 3) to the room; negative: outside, in a wall.

        Args:
            points: Positions.
            floor: The floor counts, too.
        """
        ground, y = points[:, [0, 2]], points[:, 1]
        inside = np.zeros(len(points), bool)
        for r in self.plan:
            inside |= ((ground > [r.x0, r.z0]) & (ground < [r.x1, r.z1])).all(1)
        distance = np.full(len(points), np.inf)
        for wall in self.walls:
            along = wall.end - wall.start
            t = np.clip((ground - wall.start) @ along / (along @ along), 0, 1)
            distance = np.minimum(distance, np.linalg.norm(ground - wall.start - t[:, None] * along, axis=1))
        distance = np.where(inside, distance, -distance)
        distance = np.minimum(distance, SAFE * (self.ceiling(points[:, 0], points[:, 2]) - y))
        for c in self.columns:
            distance = np.minimum(distance, np.linalg.norm(ground - [c.x, c.z], axis=1) - c.radius)
        for b in self.boxes:
            q = np.maximum(np.array(b.low) - points, points - np.array(b.high))
            outside = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
            if not floor:  # standing on it is no collision
                outside = np.where(points[:, 1] > b.high[1] - 0.05, np.inf, outside)
            distance = np.minimum(distance, outside)
        return np.minimum(distance, y) if floor else distance

    def floor(self, ground: Floats) -> Floats:
        """Return the height on which things rest at points (N, 2) of x and z."""
        height = np.zeros(len(ground))
        for b in self.boxes:
            if b.low[1] <= 0:
                on = ((ground > [b.low[0], b.low[2]]) & (ground < [b.high[0], b.high[2]])).all(1)
                height = np.where(on, np.maximum(height, b.high[1]), height)
        return height


def _cells(plan: list[Rect]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the lines of the plan in x and z, and which cells between them are part of it."""
    x = np.unique([v for r in plan for v in (r.x0, r.x1)])
    z = np.unique([v for r in plan for v in (r.z0, r.z1)])
    cx, cz = (x[:-1] + x[1:]) / 2, (z[:-1] + z[1:]) / 2
    inside = np.zeros((len(cx), len(cz)), bool)
    for r in plan:
        inside |= ((cx > r.x0) & (cx < r.x1))[:, None] & ((cz > r.z0) & (cz < r.z1))[None, :]
    return x, z, inside


def plan_walls(plan: list[Rect]) -> list[Wall]:
    """Return the walls around the union of rectangles."""
    x, z, inside = _cells(plan)
    cell = np.pad(inside, 1)
    walls = []
    for i in range(len(x)):
        for j in range(len(z) - 1):
            left, right = cell[i, j + 1], cell[i + 1, j + 1]
            a, b = np.array([x[i], z[j]]), np.array([x[i], z[j + 1]])
            if left != right:
                walls.append(Wall(b, a) if right else Wall(a, b))
    for i in range(len(x) - 1):
        for j in range(len(z)):
            below, above = cell[i + 1, j], cell[i + 1, j + 1]
            a, b = np.array([x[i], z[j]]), np.array([x[i + 1], z[j]])
            if below != above:
                walls.append(Wall(a, b) if above else Wall(b, a))
    return walls


@dataclass(frozen=True)
class Hole:
    """An opening of a wall: where it starts and ends along it, its lower and upper edge."""

    start: float
    end: float
    low: float
    high: float


def _quads(points: Floats, keep: NDArray[np.bool_]) -> Mesh | None:
    """Return the kept cells (R - 1, C - 1) of a grid (R, C, 3) as a flat mesh."""
    faces = grid_faces(*points.shape[:2]).reshape(2, -1, 3)[:, keep.reshape(-1)].reshape(-1, 3)
    return box_uvs(flat(points.reshape(-1, 3), faces)) if len(faces) else None


def wall_meshes(
    wall: Wall, ceiling: Ceiling, holes: list[Hole], depth: float
) -> tuple[list[Mesh], list[Mesh]]:
    """Return the mesh of a wall with holes, and the reveals of the holes, `depth` deep, on the outside."""
    length = float(np.linalg.norm(wall.end - wall.start))
    way = (wall.end - wall.start) / length
    out = np.array([way[1], -way[0]])
    edges = [v for h in holes for v in (h.start, h.end)]
    s = np.unique(np.concatenate([np.linspace(0, length, WALL_STEPS + 1), edges]))
    ground = wall.start + s[:, None] * way
    # A step back from the plan's edge, where a ceiling may be undefined.
    inner = wall.start + np.clip(s, 1e-4, length - 1e-4)[:, None] * way - 1e-4 * out
    top = ceiling(inner[:, 0], inner[:, 1])
    levels = np.unique([0.0, *(v for h in holes for v in (h.low, h.high))])
    rows = [np.full(len(s), v) for v in levels] + [top]
    points = np.stack([np.stack([ground[:, 0], y, ground[:, 1]], 1) for y in rows])
    middle_s = (s[:-1] + s[1:]) / 2
    bottom = np.append(levels, np.inf)[:-1]
    keep = np.ones((len(rows) - 1, len(s) - 1), bool)
    for h in holes:
        across = (middle_s > h.start) & (middle_s < h.end)
        keep &= ~(((bottom >= h.low - 1e-9) & (bottom < h.high - 1e-9))[:, None] & across[None, :])
    body = _quads(points[:, ::-1], keep[:, ::-1])
    reveals = [_reveal(wall.start, way, out * depth, h) for h in holes]
    return ([body] if body is not None else []), reveals


def _reveal(start: Floats, way: Floats, out: Floats, hole: Hole) -> Mesh:
    """Return the four inner faces of an opening."""
    corners = [(hole.start, hole.low), (hole.end, hole.low), (hole.end, hole.high), (hole.start, hole.high)]
    ring = np.array([[*(start + s * way), y] for s, y in [*corners, corners[0]]])[:, [0, 2, 1]]
    outer = ring + np.array([out[0], 0, out[1]])
    return box_uvs(flat(np.concatenate([outer, ring]), grid_faces(2, 5)))


def cuboid(box: Box) -> Mesh:
    """Return a box, front outside."""
    low, high = np.array(box.low), np.array(box.high)
    parts = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for side, ends in ((high, (low, high)), (low, (high, low))):
            quad = np.empty((2, 2, 3))
            quad[..., axis] = side[axis]
            quad[0, :, b], quad[1, :, b] = ends[0][b], ends[1][b]
            quad[:, 0, c], quad[:, 1, c] = low[c], high[c]
            parts.append(box_uvs(flat(quad.reshape(-1, 3), grid_faces(2, 2))))
    return joined(parts)


def plan_mesh(plan: list[Rect], height: Ceiling, skylight: Rect | None, up: bool) -> Mesh:
    """Return floor or ceiling over the plan, bent as `height` is, without the skylight."""
    x, z, _ = _cells([*plan, *([skylight] if skylight else [])])
    fine = [np.unique(np.concatenate([np.linspace(a[0], a[-1], 33), a])) for a in (x, z)]
    if up:
        fine = [x, z]
    cx, cz = ((a[:-1] + a[1:]) / 2 for a in fine)
    keep = np.zeros((len(cx), len(cz)), bool)
    for r in plan:
        keep |= ((cx > r.x0) & (cx < r.x1))[:, None] & ((cz > r.z0) & (cz < r.z1))[None, :]
    if skylight and not up:
        r = skylight
        keep &= ~(((cx > r.x0) & (cx < r.x1))[:, None] & ((cz > r.z0) & (cz < r.z1))[None, :])
    gx, gz = np.meshgrid(*fine, indexing="ij")
    points = np.stack([gx, height(gx, gz), gz], -1)
    mesh = _quads(points[:, ::-1] if up else points, keep[:, ::-1] if up else keep)
    assert mesh is not None
    return mesh
