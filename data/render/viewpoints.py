"""Cameras of random scenes: views that show the objects, paths that touch nothing, lenses, moving objects.

Scenes are judged by a sketch of them: bounding spheres in their surroundings, met by a few rays per view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data.render.placement import Layout, Surroundings
from data.render.spec import Shot, View
from data.render.surfaces import affine, rotation, unit

Floats = NDArray[np.float64]
Rng = np.random.Generator

SHRUNK = 0.7
"""Most things fill about this part of their bounding spheres' radius."""

FAR = 80.0
GAP = 0.2
"""Distance that a camera keeps from everything."""


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


def score(seen: Seen, rng: Rng) -> float:
    """Return how good a view is: many things, none that hides the rest, nothing right before the lens."""
    things = seen.thing >= 0
    cover = float(things.mean())
    counts = np.bincount(seen.thing[things], minlength=1) / len(things)
    near = float(np.quantile(seen.distance, 0.05))
    value = min(cover, 0.65) + 0.02 * min(int((counts > 0).sum()), 15)
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


def choose_view(rng: Rng, sketch: Sketch, shot: Shot, tries: int = 14) -> View:
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


def with_lens(rng: Rng, sketch: Sketch, view: View) -> View:
    """Return the view through a lens focused on one of the things in it.

    The circle of confusion of a point at infinity is 4 to 30 pixels in an image 256 pixels wide.
    """
    seen = sketch.trace(view.to_world[:3, 3], rays(view))
    things = np.flatnonzero(seen.thing >= 0)
    ray = int(rng.choice(things)) if len(things) else int(rng.integers(len(seen.distance)))
    cosine = float(seen.directions[ray] @ view.to_world[:3, 2])
    focus = float(np.clip(min(seen.distance[ray], FAR) * cosine, 0.3, FAR))
    diameter = np.exp(rng.uniform(np.log(4), np.log(30))) * view.width / 256
    aperture = min(float(diameter * focus / (2 * focal(view))), 0.12)
    return replace(view, aperture=aperture, focus=focus)


def choose_motion(
    rng: Rng, sketch: Sketch, views: tuple[View, ...], path: bool
) -> dict[int, tuple[float, float, float]]:
    """Return displacements over one shutter (3,) of a random part of the things, by their numbers.

    In a still they are 3 to 40 pixels at an image width of 256, as the first camera sees them; along a path,
    where every frame adds one, 0.5 to 4 pixels. What would leave the room or hit a camera stays.
    """
    layout, view, frames = sketch.layout, views[0], len(views)
    share, result = rng.uniform(0.1, 0.6), {}
    depth = (layout.centres - view.to_world[:3, 3]) @ view.to_world[:3, 2]
    times = np.linspace(-0.5, frames - 0.5, 2 * frames + 1)
    cameras = np.stack([v.to_world[:3, 3] for v in views])
    for k in range(sketch.things):
        moves, way = (
            rng.random() < share,
            unit(rng.normal(size=3) * [1, 0.15 if rng.random() < 0.7 else 1, 1]),
        )
        low, high = (0.5, 4.0) if path else (3.0, 40.0)
        pixels = np.exp(rng.uniform(np.log(low), np.log(high))) * (1 if path else view.width / 256)
        if not moves:
            continue
        length = min(pixels * max(depth[k], 1.0) / focal(view), 1.5, 4.0 / frames)
        shift = way * length
        centre, radius = layout.centres[k], layout.radii[k]
        along = centre + times[:, None] * shift
        if sketch.around.clearance(along, floor=False).min() < 0.5 * radius:
            continue
        if (along[:, 1] < sketch.around.floor(along[:, [0, 2]]) + 0.2 * radius).any():
            continue
        # The camera of frame i is open from i - 0.5 to i + 0.5, while the thing moves on.
        open_at = np.arange(frames)[:, None] + np.array([-0.5, 0.0, 0.5])
        at = centre + open_at[..., None] * shift
        if (np.linalg.norm(at - cameras[:, None], axis=2) < radius + GAP).any():
            continue
        result[k] = (float(shift[0]), float(shift[1]), float(shift[2]))
    return result
