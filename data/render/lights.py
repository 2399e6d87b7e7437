"""Lamps of rooms: four area lights of different shapes, sizes and colours, and a point light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.render.placement import Layout
from data.render.rooms import Room
from data.render.surfaces import affine, unit
from data.render.textures import random_colour

Floats = NDArray[np.float64]
Rng = np.random.Generator
Plugin = dict[str, Any]

WARM, COOL = np.array([1.0, 0.62, 0.3]), np.array([0.75, 0.88, 1.1])


def light_colour(rng: Rng) -> Floats:
    """Return a colour (3,) of mean 1: between warm and cool white, at times vivid."""
    t = rng.random()
    colour = WARM * (1 - t) + COOL * t
    if rng.random() < 0.2:
        colour = random_colour(rng) + 0.05
    return colour / colour.mean()


def free_point(rng: Rng, room: Room, layout: Layout, gap: float, low: float) -> Floats:
    """Return a point (3,) above a share `low` of the height, away from walls and things if possible."""
    start, end = room.bounds
    best, most = (start + end) / 2, -np.inf
    for _ in range(80):
        point = rng.uniform([start[0], low * end[1], start[2]], end)
        wall = float(room.clearance(point[None])[0])
        thing = float((np.linalg.norm(layout.centres - point, axis=1) - layout.radii).min(initial=np.inf))
        if min(wall, thing) > most:
            best, most = point, min(wall, thing)
        if most > gap:
            break
    return best


def _facing(direction: Floats) -> Floats:
    """Return a 3x3 rotation that takes +Z to a direction."""
    side = unit(np.cross([0.3, 0.1, 0.95] if abs(direction[1]) > 0.9 else [0.0, 1.0, 0.0], direction))
    return np.stack([side, np.cross(direction, side), direction], 1)


def area_light(rng: Rng, room: Room, layout: Layout, flux: float) -> Plugin:
    """Return a rectangle, strip, disc or ball that emits `flux`, and note it in the layout."""
    kind = str(rng.choice(["rectangle", "strip", "disk", "sphere"], p=[0.35, 0.15, 0.25, 0.25]))
    size = float(np.exp(rng.uniform(np.log(0.1), np.log(0.5))))
    half = np.array([size, size * rng.uniform(0.5, 1.0)])
    if kind == "strip":
        half = np.array([size + 0.3, 0.03])
    elif kind == "disk":
        half = np.array([size, size])
    elif kind == "sphere":
        half = np.full(2, size * 0.5)
    reach = float(half.max())
    position = free_point(rng, room, layout, reach + 0.05, 0.45)
    start, end = room.bounds
    aim = rng.uniform(start, end) * [0.6, 0.2, 0.6] - position
    aim = unit(aim) if rng.random() < 0.6 else np.array([0.0, -1.0, 0.0])
    layout.centres = np.concatenate([layout.centres, position[None]])
    layout.radii = np.append(layout.radii, reach)
    layout.tops = np.append(layout.tops, position[1] + reach)
    area = {"sphere": 4 * np.pi * half[0] ** 2, "disk": np.pi * half[0] ** 2}.get(kind, 4 * half[0] * half[1])
    radiance = light_colour(rng) * flux / (np.pi * area)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}}
    if kind == "sphere":
        return {"type": "sphere", "center": position.tolist(), "radius": float(half[0]), "emitter": emitter}
    matrix = affine(_facing(aim) @ np.diag([*half, 1.0]), position)
    return {"type": "disk" if kind == "disk" else "rectangle", "to_world": matrix, "emitter": emitter}


def room_lights(rng: Rng, room: Room, layout: Layout, level: float) -> dict[str, Plugin]:
    """Return four area lights and a point light that light the room to a mean radiance of about `level`.

    In a closed room of surface A and mean reflectance 0.5 the flux F makes a mean radiance F / (pi A).
    """
    flux = np.pi * room.area * level
    share = rng.dirichlet(np.full(4, 1.5)) * 0.8 + 0.05
    point_share = rng.uniform(0.04, 0.2)
    lights = {
        f"light-{i}": area_light(rng, room, layout, flux * share[i] * (1 - point_share)) for i in range(4)
    }
    position = free_point(rng, room, layout, 0.4, 0.4)
    intensity = light_colour(rng) * flux * point_share / (4 * np.pi)
    value = {"type": "rgb", "value": intensity.tolist()}
    return lights | {"light-point": {"type": "point", "position": position.tolist(), "intensity": value}}
