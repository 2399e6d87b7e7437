"""Blur of random scenes: lenses focused on one of the things, things that move while the shutter is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data.render.sketch import FAR, Sketch, focal, rays
from data.render.spec import View
from data.render.surfaces import unit
from data.render.viewpoints import GAP

Rng = np.random.Generator


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
