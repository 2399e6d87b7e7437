"""The user's own scenes: Mitsuba XML files, seen from their camera, from around it, or along a path."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from data.render.camera_paths import Jitter, jittered, keyframed, orbit
from data.render.loading import load_file
from data.render.scene_files import declared_sensors, scene_files, scene_files_hash, scene_name
from data.render.spec import SceneSpec, Shot, View
from data.render.tracer import Tracer

__all__ = ["CameraMove", "scene_files", "scene_files_hash", "user_scene"]

NOT_STATED = "not stated"
_TRIES = 48
_PREVIEW = (32, 16)
"""Columns and samples per pixel of the small images that views are judged by."""
_SENSORS = ("perspective", "thinlens")


@dataclass(frozen=True)
class CameraMove:
    """What the camera of a file does.

    Attributes:
        kind: `fixed`; `jitter`: the file's camera, then independent views around it; `orbit`: an arc that
            begins at it; `keyframes`: a path from a file.
        path: JSON file of the key frames.
        degrees: Angle of the whole orbit.
        jitter: How far independent views may be from the file's camera.
        digest: SHA-256 of the key frames, filled in; it tells moves apart whose file has changed.
    """

    kind: Literal["fixed", "jitter", "orbit", "keyframes"]
    path: Path | str | None = None
    degrees: float = 7.0
    jitter: Jitter = field(default_factory=Jitter)
    digest: str = ""

    def __post_init__(self) -> None:
        if self.kind not in ("fixed", "jitter", "orbit", "keyframes"):
            raise ValueError(f"camera move {self.kind!r}; known: fixed, jitter, orbit, keyframes")
        if (self.path is None) == (self.kind == "keyframes"):
            raise ValueError(f"camera move {self.kind!r}: a file of key frames goes with `keyframes` only")
        if self.path is not None:
            file = Path(self.path)
            if not file.is_file():
                raise ValueError(f"key frames {file} do not exist")
            # Plain text, so that `asdict` of a move is plain JSON.
            object.__setattr__(self, "path", str(file))
            object.__setattr__(self, "digest", hashlib.sha256(file.read_bytes()).hexdigest())


def user_scene(path: Path, shot: Shot, move: CameraMove, seed: int) -> SceneSpec:
    """Return a scene file with its views; needs an active variant, since views are judged by small renders.

    The horizontal field of view is the file's, whatever the shape of the shot's images. Views that jitter or
    orbit are taken only if nothing is between them and the file's camera, and if what they see is like what
    it sees: share of hits, distance of the nearest things and median luminance.

    Args:
        path: Mitsuba XML.
        shot: Size and number of the views.
        move: What the camera does.
        seed: Of its random moves.

    Raises:
        ValueError: The file or something it refers to is missing or broken, it has no usable camera, or no
            acceptable view was found.
    """
    path = Path(path)
    files = scene_files(path)
    original = _file_view(path, shot)
    credit, terms = _terms(path)
    spec = SceneSpec(
        name=scene_name(path),
        content=path,
        views=(original,),
        path=move.kind in ("orbit", "keyframes") or (move.kind == "fixed" and shot.path),
        origin={
            "generator": "file",
            "path": path.name,
            "files": files,
            "move": json.loads(json.dumps(asdict(move))),
            "shot": asdict(shot),
            "seed": seed,
        },
        credit=credit,
        license=terms,
    )
    return replace(spec, views=_views(spec, shot, move, np.random.default_rng(seed)))


def _terms(path: Path) -> tuple[str, str]:
    """Return author and licence as a text file beside the scene states them."""
    candidates = [path.with_suffix(".license"), path.with_name(f"{path.name}.license")]
    candidates += [path.with_name(name) for name in ("LICENSE", "LICENSE.txt", "LICENSE.md")]
    for candidate in candidates:
        if candidate.is_file():
            text = candidate.read_text(encoding="utf-8", errors="replace")[:4000]
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            marks = ("credit", "author", "copyright", "(c)", "©")
            credit = next((line for line in lines if line.lower().startswith(marks)), NOT_STATED)
            return credit[:200], " ".join(lines[:3])[:300] or NOT_STATED
    return NOT_STATED, NOT_STATED


def _file_view(path: Path, shot: Shot) -> View:
    """Return the camera of a file, with the size of the shot."""
    import mitsuba

    scene = load_file(path)
    declared = [element.get("type") for element in declared_sensors(path, path.parent)]
    if not declared:
        raise ValueError(f'scene {path} has no camera; add a <sensor type="perspective">')
    if declared[0] not in _SENSORS:
        raise ValueError(f"scene {path}: its camera is {declared[0]!r}; usable: {', '.join(_SENSORS)}")
    parameters = mitsuba.traverse(scene.sensors()[0])
    matrix = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)

    def value(name: str, default: float) -> float:
        return float(np.ravel(parameters[name])[0]) if name in parameters else default

    return View(
        matrix,
        value("x_fov", 45.0),
        shot.width,
        shot.height,
        value("near_clip", 1e-2),
        value("far_clip", 1e4),
        value("aperture_radius", 0.0),
        value("focus_distance", 1.0),
    )


def _views(spec: SceneSpec, shot: Shot, move: CameraMove, rng: np.random.Generator) -> tuple[View, ...]:
    original = spec.views[0]
    if move.kind == "fixed" or (shot.frames == 1 and move.kind != "keyframes"):
        return (original,) * shot.frames
    if move.kind == "keyframes":
        return keyframed(Path(str(move.path)), original, shot.frames)
    judge = _Judge(spec)
    if move.kind == "orbit":
        return _orbit(judge, original, move.degrees * rng.choice([-1.0, 1.0]), shot.frames)
    views = [original]
    while len(views) < shot.frames:
        views.append(_around(judge, original, move.jitter, rng))
    return tuple(views)


def _around(judge: _Judge, original: View, jitter: Jitter, rng: np.random.Generator) -> View:
    """Return an accepted view; the reach shrinks with every rejected one."""
    reach = jitter
    for _ in range(_TRIES):
        (view,) = jittered(original, judge.pivot, 1, rng, reach)
        if judge.accepts(original, view):
            return view
        low, high = reach.degrees
        reach = replace(reach, degrees=(low * 0.9, high * 0.9), dolly=reach.dolly * 0.9)
    raise ValueError(_no_view(judge))


def _orbit(judge: _Judge, original: View, degrees: float, frames: int) -> tuple[View, ...]:
    for attempt in range(_TRIES // 2):
        angle = degrees * 0.75 ** (attempt // 2) * (-1) ** attempt
        views = orbit(original, judge.pivot, angle, frames)
        steps = pairwise(views)
        if all(judge.reaches(a, b) for a, b in steps) and all(
            judge.accepts(original, view) for view in (views[-1], views[frames // 2])
        ):
            return views
    raise ValueError(_no_view(judge))


def _no_view(judge: _Judge) -> str:
    return (
        f"scene {judge.name}: no other view near its camera is free and sees as much; "
        "keep the camera fixed, or give key frames"
    )


@dataclass(frozen=True)
class _Sight:
    """What a view sees: share of hits, 2nd percentile of depth, median luminance, median depth."""

    hits: float
    near: float
    luminance: float
    depth: float


class _Judge:
    """Tells views from which as much is seen as from the file's camera."""

    def __init__(self, spec: SceneSpec) -> None:
        width, _ = _PREVIEW
        view = spec.views[0]
        height = max(1, round(width * view.height / view.width))
        self.name = spec.name
        self._size = (width, height)
        self._preview = replace(spec, views=(self._small(view),))
        self._tracer = Tracer(self._preview)
        self._original = self._sight(view)
        if self._original.hits == 0:
            raise ValueError(f"scene {spec.name}: its camera sees nothing")
        matrix = np.asarray(view.to_world, np.float64)
        self.pivot: NDArray[np.float64] = matrix[:3, 3] + matrix[:3, 2] * self._original.depth

    def accepts(self, original: View, view: View) -> bool:
        """Return whether the way to a view is free and it sees as much as the original."""
        if not self.reaches(original, view):
            return False
        seen, wanted = self._sight(view), self._original
        bright = max(wanted.luminance, 1e-6)
        return (
            seen.hits >= wanted.hits - 0.1
            and seen.near >= 0.5 * wanted.near
            and 0.5 * bright <= max(seen.luminance, 1e-6) <= 2 * bright
        )

    def reaches(self, begin: View, end: View) -> bool:
        """Return whether nothing is between two cameras."""
        a, b = (np.asarray(v.to_world, np.float64)[:3, 3] for v in (begin, end))
        return self._tracer.free(a, b)

    def _sight(self, view: View) -> _Sight:
        self._preview.views = (self._small(view),)
        _, spp = _PREVIEW
        (chunk,) = self._tracer.trace(0, spp, 0, ("radiance", "depth", "hit"))
        depth, hit, light = (chunk.values[name] for name in ("depth", "hit", "radiance"))
        seen = depth[hit > 0]
        near, middle = np.percentile(seen, [2, 50]) if seen.size else (0.0, 0.0)
        luminance = light.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
        # The median of single samples is often that of black ones.
        typical = float(np.median(luminance.mean(0)))
        return _Sight(float(hit.mean()), float(near), typical, float(middle))

    def _small(self, view: View) -> View:
        width, height = self._size
        return replace(view, width=width, height=height)
