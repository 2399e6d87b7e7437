"""Cameras that move: orbits, independent views around a camera, and key frames from a file. No renderer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.render.spec import View

Point = Sequence[float] | NDArray[np.float64]
_KEYS = ("frame", "origin", "target", "up", "fov")


def look_at(origin: Point, target: Point, up: Point = (0.0, 1.0, 0.0)) -> NDArray[np.float64]:
    """Return a camera-to-world matrix (4, 4) in Mitsuba's convention: +Z forward, +X to the LEFT, +Y up.

    Args:
        origin: Centre of the camera.
        target: Point in the middle of the image.
        up: Direction that is upright in the image.

    Raises:
        ValueError: `target` is `origin`, or `up` points along the line of sight.
    """
    eye = np.asarray(origin, np.float64)
    forward = np.asarray(target, np.float64) - eye
    length = np.linalg.norm(forward)
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError(f"a camera at {eye.tolist()} cannot look at its own position")
    forward = forward / length
    left = np.cross(np.asarray(up, np.float64), forward)
    if not np.isfinite(left).all() or np.linalg.norm(left) < 1e-9:
        raise ValueError(f"up {list(up)} is parallel to the line of sight {forward.tolist()}")
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([left, np.cross(forward, left), forward, eye], 1)
    return matrix


def orbit(view: View, pivot: Point, degrees: float, frames: int) -> tuple[View, ...]:
    """Return views along an arc about the vertical through a point, the camera's own view first.

    Args:
        view: Where the path begins.
        pivot: Centre of the arc.
        degrees: Whole angle; positive turns counter-clockwise seen from above.
        frames: Number of views.
    """
    if frames < 1:
        raise ValueError(f"an orbit of {frames} frames; expected at least 1")
    steps = np.linspace(0.0, degrees, frames) if frames > 1 else [0.0]
    return tuple(_turned(view, pivot, (float(step), 0.0), 1.0) for step in steps)


@dataclass(frozen=True)
class Jitter:
    """How far independent views may be from the original one.

    Attributes:
        degrees: Smallest and largest angle about the pivot.
        dolly: Largest change of the distance to the pivot, as a share of it.
        tilt: Largest share of the angle that goes up or down.
    """

    degrees: tuple[float, float] = (8.0, 22.0)
    dolly: float = 0.35
    tilt: float = 0.35


def jittered(
    view: View, pivot: Point, count: int, rng: np.random.Generator, jitter: Jitter | None = None
) -> tuple[View, ...]:
    """Return independent random views that look at the same point from around the original camera.

    Args:
        view: The original camera; it is not among the results.
        pivot: Point that the camera turns about and whose place in the image is kept.
        count: Number of views.
        rng: Source of randomness.
        jitter: How far.
    """
    reach = jitter or Jitter()
    result = []
    for _ in range(count):
        angle = rng.uniform(*reach.degrees) * rng.choice([-1.0, 1.0])
        tilt = reach.degrees[1] * reach.tilt * rng.uniform(-1.0, 1.0)
        result.append(_turned(view, pivot, (angle, tilt), 1.0 + reach.dolly * rng.uniform(-1.0, 1.0)))
    return tuple(result)


def _turned(view: View, pivot: Point, degrees: tuple[float, float], distance: float) -> View:
    """Return a view turned about a point: around the camera's upright axis and up; and nearer or farther."""
    matrix = np.asarray(view.to_world, np.float64)
    centre = np.asarray(pivot, np.float64)
    upright = _upright(matrix)
    around = _rotation(upright, degrees[0])
    side = np.cross(upright, matrix[:3, 2])
    tilt = _rotation(around @ (side / np.linalg.norm(side)), degrees[1])
    rotation = tilt @ around
    moved = matrix.copy()
    moved[:3, :3] = rotation @ matrix[:3, :3]
    moved[:3, 3] = centre + rotation @ (matrix[:3, 3] - centre) * distance
    return replace(view, to_world=moved)


def _upright(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coordinate axis that is nearest to the camera's up: files have Y or Z up."""
    up = matrix[:3, 1]
    axis = np.zeros(3)
    place = int(np.argmax(np.abs(up)))
    axis[place] = np.sign(up[place])
    forward = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    return axis if abs(axis @ forward) < 0.99 else up / np.linalg.norm(up)


def _rotation(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) about a unit axis (Rodrigues)."""
    angle = np.radians(degrees)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


@dataclass(frozen=True)
class _Key:
    frame: float
    origin: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]
    fov: float


def keyframed(path: Path, view: View, frames: int | None = None) -> tuple[View, ...]:
    """Return the views of a camera path that a JSON file describes.

    The file is a list of `{"frame": 0, "origin": [x, y, z], "target": [x, y, z], "up": […], "fov": …}` with
    increasing frame numbers; `up` and `fov` may be left out. Between the keys a cubic curve runs through
    them (Catmull and Rom 1974, with tangents for uneven distances).

    Args:
        path: The file.
        view: What the file does not say: size, lens, `fov` and `up`.
        frames: Number of views, from frame 0; None: up to the last key.

    Raises:
        ValueError: Not such a file; the message names the file, the entry and the key.
    """
    keys = _read_keys(path, view)
    count = int(keys[-1].frame) + 1 if frames is None else frames
    if count < 1:
        raise ValueError(f"{path}: {count} frames asked for, expected at least 1")
    if count - 1 > keys[-1].frame:
        raise ValueError(
            f"{path}: the last key is frame {keys[-1].frame:g}, but frame {count - 1} is asked for; add a key"
        )
    times = np.array([key.frame for key in keys])
    numbers = np.stack([[*k.origin, *k.target, *k.up, k.fov] for k in keys])
    return tuple(_at(path, view, frame, _curve(times, numbers, float(frame))) for frame in range(count))


def _at(path: Path, view: View, frame: int, values: NDArray[np.float64]) -> View:
    try:
        matrix = look_at(values[:3], values[3:6], values[6:9])
    except ValueError as error:
        raise ValueError(f"{path}: frame {frame}: {error}") from None
    return replace(view, to_world=matrix, fov=float(values[9]))


def _curve(times: NDArray[np.float64], values: NDArray[np.float64], at: float) -> NDArray[np.float64]:
    """Return a cubic Hermite curve through (K, C) values at a time, clamped to the first and last."""
    if len(times) == 1 or at <= times[0]:
        return np.asarray(values[0])
    slopes = np.gradient(values, times, axis=0)
    i = int(np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2))
    span = times[i + 1] - times[i]
    s = (at - times[i]) / span
    weights = (2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, 3 * s**2 - 2 * s**3, s**3 - s**2)
    a, b, c, d = weights
    return np.asarray(a * values[i] + b * span * slopes[i] + c * values[i + 1] + d * span * slopes[i + 1])


def _read_keys(path: Path, view: View) -> list[_Key]:
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"key frames {path} do not exist") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"key frames {path}: not a JSON file: {error}") from None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f'key frames {path}: expected a list of {{"frame", "origin", "target"}}')
    keys = [_key(path, i, entry, view) for i, entry in enumerate(entries)]
    for before, after in pairwise(keys):
        if after.frame <= before.frame:
            raise ValueError(f"{path}: frame {after.frame:g} follows frame {before.frame:g}; sort the keys")
    return keys


def _key(path: Path, place: int, entry: Any, view: View) -> _Key:
    where = f"{path}: key {place}"
    if not isinstance(entry, dict):
        raise ValueError(f'{where} is not an object with "frame", "origin" and "target"')
    unknown = [name for name in entry if name not in _KEYS]
    if unknown:
        raise ValueError(f"{where}: unknown {', '.join(map(repr, unknown))}; known: {', '.join(_KEYS)}")
    up = entry.get("up", np.asarray(view.to_world, np.float64)[:3, 1].tolist())
    fov = _number(where, "fov", entry.get("fov", view.fov))
    if not 0 < fov < 180:
        raise ValueError(f"{where}: fov is {fov:g}, expected degrees between 0 and 180")
    frame = _number(where, "frame", entry.get("frame"))
    if frame < 0:
        raise ValueError(f"{where}: frame is {frame:g}, expected 0 or more")
    origin, target = (_point(where, name, entry.get(name)) for name in ("origin", "target"))
    return _Key(frame, origin, target, _point(where, "up", up), fov)


def _number(where: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise ValueError(f"{where}: {name} is {value!r}, expected a number")
    return float(value)


def _point(where: str, name: str, value: Any) -> NDArray[np.float64]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{where}: {name} is {value!r}, expected three numbers")
    return np.array([_number(where, name, x) for x in value])
