"""Cameras of random scenes: views that show the objects, and paths that touch nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data.render.sketch import Seen, Sketch, focal, look_at, project, rays
from data.render.spec import Shot, View
from data.render.surfaces import affine, rotation, unit

Floats = NDArray[np.float64]
Rng = np.random.Generator

GAP = 0.2
"""Distance that a camera keeps from everything."""


def score(seen: Seen, rng: Rng) -> float:
    """Return how good a view is: many things, none that hides the rest, nothing right before the lens."""
    things = seen.thing >= 0
    cover = float(things.mean())
    counts = np.bincount(seen.thing[things], minlength=1) / len(things)
    near = float(np.quantile(seen.distance, 0.05))
    value = min(cover, 0.5) + 0.03 * min(int((counts > 0).sum()), 16)
    value -= 1.0 * max(counts.max() - 0.3, 0) + 0.5 * max(0.8 - near, 0) + max(cover - 0.9, 0)
    value -= 0.6 * max(float(np.isinf(seen.distance).mean()) - 0.35, 0)
    return value + float(rng.uniform(0, 0.12))


def _candidate(rng: Rng, sketch: Sketch, shot: Shot) -> View | None:
    """Return a camera that looks at one of the things, or None where it would touch something."""
    target = sketch.layout.centres[int(rng.integers(sketch.things))]
    if sketch.region is not None:
        origin = rng.uniform(*sketch.region)
    else:
        spin, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(4, 50))
        if sketch.facing is not None:
            spin = np.arctan2(sketch.facing[0], sketch.facing[2]) + rng.uniform(-0.9, 0.9)
        way = np.array([np.sin(spin) * np.cos(rise), np.sin(rise), np.cos(spin) * np.cos(rise)])
        origin = target * [0.6, 1, 0.6] + way * np.exp(rng.uniform(np.log(2.0), np.log(9.0)))
    aim = target + rng.normal(0, 0.15, 3)
    ahead = unit(aim - origin)
    if abs(ahead[1]) > 0.95 or sketch.free(origin[None])[0] < GAP:
        return None
    roll = np.radians(rng.normal(0, 4)) if rng.random() < 0.4 else 0.0
    return View(look_at(origin, aim, roll), float(rng.uniform(25, 75)), shot.width, shot.height)


def choose_view(rng: Rng, sketch: Sketch, shot: Shot, tries: int = 20) -> View:
    """Return the best of several random cameras; none touches anything.

    Raises:
        ValueError: No place was free.
    """
    best, value, found = None, -np.inf, 0
    for _ in range(tries * 40):
        view = _candidate(rng, sketch, shot)
        if view is None:
            continue
        found += 1
        mark = score(sketch.trace(view.to_world[:3, 3], rays(view)), rng)
        if mark > value:
            best, value = view, mark
        if found >= tries:
            break
    if best is None:
        raise ValueError("no free place for a camera was found")
    return best


def _orbit(rng: Rng, view: View, pivot: Floats) -> Callable[[float], Floats]:
    sign, rise = rng.choice([-1.0, 1.0]), rng.uniform(-0.3, 0.3)

    def at(s: float) -> Floats:
        turn = rotation(np.array([rise, 1.0, 0.0]), sign * s)
        return affine(turn, pivot - turn @ pivot) @ view.to_world

    return at


def _dolly(rng: Rng, view: View, pivot: Floats) -> Callable[[float], Floats]:
    way = unit(view.to_world[:3, :3] @ (rng.normal(0, 1, 3) * [1.0, 0.4, 0.8]))
    aim = rng.random() < 0.5

    def at(s: float) -> Floats:
        matrix = view.to_world.copy()
        matrix[:3, 3] += s * way
        if aim:
            before, after = pivot - view.to_world[:3, 3], pivot - matrix[:3, 3]
            axis = np.cross(before, after)
            size = np.linalg.norm(axis)
            if size > 1e-12:
                angle = float(np.arctan2(size, before @ after))
                matrix[:3, :3] = rotation(axis, angle) @ matrix[:3, :3]
        return matrix

    return at


def _pan(rng: Rng, view: View, pivot: Floats) -> Callable[[float], Floats]:
    axis = unit(view.to_world[:3, :3] @ np.array([rng.uniform(-0.3, 0.3), rng.choice([-1.0, 1.0]), 0.0]))

    def at(s: float) -> Floats:
        matrix = view.to_world.copy()
        matrix[:3, :3] = rotation(axis, s) @ matrix[:3, :3]
        return matrix

    return at


def median_motion(first: View, second: View, seen: Seen) -> float:
    """Return the median motion in pixels, between two views, of what the first one shows."""
    hit = np.isfinite(seen.distance)
    if hit.mean() < 0.1:
        hit[:] = True
    points = first.to_world[:3, 3] + np.where(hit, seen.distance, 1e4)[hit, None] * seen.directions[hit]
    moved = np.linalg.norm(project(second, points) - project(first, points), axis=1)
    moved = moved[np.isfinite(moved)]
    return float(np.median(moved)) if len(moved) else 0.0


def choose_path(rng: Rng, sketch: Sketch, shot: Shot) -> tuple[View, ...]:
    """Return consecutive views along an orbit, a dolly or a pan; 1 to 4 pixels of median motion per frame.

    A path that would touch something is drawn again; a pan, which turns on the spot, never does.
    """
    target = rng.uniform(1.2, 3.6)
    for attempt in range(12):
        view = choose_view(rng, sketch, shot, 8)
        seen = sketch.trace(view.to_world[:3, 3], rays(view))
        finite = seen.distance[np.isfinite(seen.distance)]
        reach = float(np.median(finite)) if len(finite) else 5.0
        pivot = view.to_world[:3, 3] + reach * view.to_world[:3, 2]
        kind = _pan if attempt == 11 else (_orbit, _dolly, _pan)[int(rng.choice(3, p=[0.45, 0.35, 0.2]))]
        at = kind(rng, view, pivot)
        speed = target / max(focal(view), 1.0) * (reach if kind is _dolly else 1.0)
        for _ in range(4):
            moved = median_motion(view, replace(view, to_world=at(speed)), seen)
            speed *= float(np.clip(target / max(moved, 1e-3), 0.2, 5.0))
        views = tuple(replace(view, to_world=at(speed * i)) for i in range(shot.frames))
        if _good_path(sketch, views, kind is _pan):
            return views
    return views


def _good_path(sketch: Sketch, views: tuple[View, ...], pan: bool) -> bool:
    """Return whether a path stays free, moves as wanted all along, and still shows things at its end."""
    origins = np.stack([v.to_world[:3, 3] for v in views])
    if not pan and sketch.free(origins).min() < 0.75 * GAP:
        return False
    last = sketch.trace(origins[-1], rays(views[-1]))
    if len(views) > 1 and (last.thing >= 0).mean() < 0.2 and not pan:
        return False
    for first, second in zip(views[:-1:3], views[1::3], strict=False):
        moved = median_motion(first, second, sketch.trace(first.to_world[:3, 3], rays(first)))
        if not 0.8 <= moved <= 4.5:
            return False
    return True
