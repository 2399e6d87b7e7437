"""The eight kinds of rooms and how one is drawn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data.render.rooms import (
    Box,
    Ceiling,
    Column,
    Hole,
    Rect,
    Room,
    Wall,
    cuboid,
    plan_mesh,
    plan_walls,
    wall_meshes,
)
from data.render.spec import Mesh
from data.render.surfaces import box_uvs, grid_mesh, joined

Floats = NDArray[np.float64]
Rng = np.random.Generator


def _level(height: float) -> Ceiling:
    return lambda x, z: np.full(np.shape(x), height)


def _rectangle(rng: Rng, low: float, high: float) -> Rect:
    w, d = rng.uniform(low, high, 2) / 2
    return Rect(-w, -d, w, d)


def _box(rng: Rng) -> Room:
    height = rng.uniform(2.5, 4.0)
    return Room("box", [_rectangle(rng, 4.5, 8.0)], _level(height), height)


def _l_shape(rng: Rng) -> Room:
    r, height = _rectangle(rng, 6.0, 9.0), rng.uniform(2.5, 3.8)
    cut_x, cut_z = rng.uniform(-0.1, 0.3, 2) * [r.x1, r.z1]
    plan = [Rect(r.x0, r.z0, cut_x, r.z1), Rect(r.x0, r.z0, r.x1, cut_z)]
    return Room("l_shape", plan, _level(height), height)


def _corridor(rng: Rng) -> Room:
    w, length, height = rng.uniform(1.1, 1.6), rng.uniform(5.0, 7.5), rng.uniform(2.4, 3.2)
    plan = [Rect(-w, -length, w, length)]
    for side in (-1, 1):
        if rng.random() < 0.8:
            at, deep, wide = rng.uniform(-0.6, 0.4) * length, rng.uniform(0.6, 1.8), rng.uniform(0.8, 2.0)
            edges = sorted((side * w, side * (w + deep)))
            plan.append(Rect(edges[0], at, edges[1], at + wide))
    return Room("corridor", plan, _level(height), height)


def _pillars(rng: Rng) -> Room:
    r, height = _rectangle(rng, 7.0, 10.0), rng.uniform(3.2, 5.0)
    count = int(rng.integers(2, 4))
    at_z = np.linspace(r.z0, r.z1, count + 2)[1:-1]
    aside, size = r.x1 * rng.uniform(0.4, 0.65), rng.uniform(0.15, 0.35)
    room = Room("pillars", [r], _level(height), height)
    for z in at_z:
        for x in (-aside, aside):
            if rng.random() < 0.15:
                continue
            if count == 2:
                room.boxes.append(Box((x - size, -1.0, z - size), (x + size, height, z + size)))
            else:
                room.columns.append(Column(x, float(z), size))
    return room


def _vault(rng: Rng) -> Room:
    r = _rectangle(rng, 5.0, 8.0)
    spring, rise = rng.uniform(1.8, 2.6), r.x1 * rng.uniform(0.5, 1.0)

    def ceiling(x: Floats, z: Floats) -> Floats:
        return spring + rise * np.sqrt(np.maximum(1 - (x / r.x1) ** 2, 0))

    return Room("vault", [r], ceiling, spring + rise)


def _windows(rng: Rng) -> Room:
    height = rng.uniform(2.8, 4.2)
    return Room("windows", [_rectangle(rng, 5.0, 8.5)], _level(height), height)


def _attic(rng: Rng) -> Room:
    r, knee = _rectangle(rng, 5.0, 8.0), rng.uniform(0.9, 1.6)
    slope, ridge = rng.uniform(0.5, 0.95), rng.uniform(-0.3, 0.3) * r.x1
    rise = slope * (r.x1 - abs(ridge))

    def ceiling(x: Floats, z: Floats) -> Floats:
        return np.clip(knee + rise - slope * np.abs(x - ridge), 0.6, None)

    return Room("attic", [r], ceiling, knee + rise)


def _two_level(rng: Rng) -> Room:
    r, height = _rectangle(rng, 6.5, 9.5), rng.uniform(3.4, 4.6)
    room, edge, deck = (
        Room("two_level", [r], _level(height), height),
        r.x1 * rng.uniform(0.0, 0.4),
        rng.uniform(0.4, 1.2),
    )
    room.boxes.append(Box((edge, -1.0, r.z0), (r.x1, deck, r.z1)))
    steps, z = int(rng.integers(2, 5)), rng.uniform(-0.5, 0.2) * r.z1
    for k in range(1, steps):
        room.boxes.append(Box((edge - 0.3 * (steps - k), -1.0, z), (edge, deck * k / steps, z + 1.2)))
    if rng.random() < 0.5:
        side = rng.uniform(0.4, 0.6) * r.x0
        room.boxes.append(Box((r.x0, 2.0, r.z0), (side, 2.2, r.z1)))
    return room


ROOMS: dict[str, Callable[[Rng], Room]] = {
    "box": _box,
    "l_shape": _l_shape,
    "corridor": _corridor,
    "pillars": _pillars,
    "vault": _vault,
    "windows": _windows,
    "attic": _attic,
    "two_level": _two_level,
}
"""Name → draws plan, ceiling and solids, 8 of them."""


def _holes(rng: Rng, wall: Wall, ceiling: Ceiling, many: bool) -> list[Hole]:
    """Return openings of a wall: a door, a window, or a row of windows."""
    length = float(np.linalg.norm(wall.end - wall.start))
    ends = np.stack([wall.start, (wall.start + wall.end) / 2, wall.end]) * 0.999
    top = float(ceiling(ends[:, 0], ends[:, 1]).min())
    if length < 1.2 or top < 1.7:
        return []
    low = rng.uniform(0.3, 1.0) if rng.random() < 0.8 else 0.0
    high = min(top - 0.2, low + rng.uniform(1.0, 2.2))
    count = int(rng.integers(2, 5)) if many and length > 3 else 1
    pitch = length / count
    width = min(pitch * rng.uniform(0.3, 0.8), 2.5)
    shift = 0.0 if count > 1 else rng.uniform(-0.5, 0.5) * (pitch - width - 0.2)
    middle = (np.arange(count) + 0.5) * pitch + shift
    return [Hole(float(m - width / 2), float(m + width / 2), low, high) for m in middle]


def random_room(rng: Rng, kind: str) -> Room:
    """Return a room of a kind with openings to the outside.

    Args:
        rng: Source of all choices.
        kind: A name of `ROOMS`.
    """
    room = ROOMS[kind](rng)
    room.walls = plan_walls(room.plan)
    many = kind == "windows"
    lengths = np.array([np.linalg.norm(w.end - w.start) for w in room.walls])
    wanted = min(len(room.walls), int(rng.integers(2, 4)) if many else int(rng.integers(1, 3)))
    opened = set(np.argsort(-lengths * rng.random(len(lengths)))[:wanted].tolist())
    bodies: list[Mesh] = []
    trim: list[Mesh] = []
    depth = rng.uniform(0.08, 0.35)
    for i, wall in enumerate(room.walls):
        holes = _holes(rng, wall, room.ceiling, many) if i in opened else []
        body, reveals = wall_meshes(wall, room.ceiling, holes, depth)
        bodies += body
        trim += reveals
    split = len(bodies) > 3 and rng.random() < 0.5
    chosen = int(rng.integers(len(bodies)))
    room.parts["walls"] = joined([b for i, b in enumerate(bodies) if not (split and i == chosen)])
    if split:
        room.parts["accent"] = bodies[chosen]
    skylight = _skylight(rng, room) if rng.random() < (0.7 if kind == "attic" else 0.2) else None
    room.parts["floor"] = plan_mesh(room.plan, _level(0.0), None, True)
    room.parts["ceiling"] = plan_mesh(room.plan, room.ceiling, skylight, False)
    trim += [cuboid(b) for b in room.boxes] + [_pillar(c, room.height) for c in room.columns]
    if trim:
        room.parts["trim"] = joined(trim)
    return room


def _skylight(rng: Rng, room: Room) -> Rect:
    r = room.plan[0]
    w, d = (r.x1 - r.x0) * rng.uniform(0.15, 0.3), (r.z1 - r.z0) * rng.uniform(0.15, 0.4)
    x = rng.uniform(r.x0 + 0.2, r.x1 - 0.2 - w)
    z = rng.uniform(r.z0 + 0.2, r.z1 - 0.2 - d)
    return Rect(x, z, x + w, z + d)


def _pillar(column: Column, height: float) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 33)
    ring = np.stack([column.x + column.radius * np.cos(angle), column.z + column.radius * np.sin(angle)], 1)
    points = np.stack([np.stack([ring[:, 0], np.full(33, y), ring[:, 1]], 1) for y in (0.0, height)])
    return box_uvs(grid_mesh(points))
