"""Tiny scenes for tests of the tracer."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from data.render import variant as variants
from data.render.camera_paths import look_at
from data.render.spec import Mesh, Picture, SceneSpec, View
from data.render.tracer import Tracer
from data.render.variant import Variant, choose

GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.15}
PRINCIPLED = {
    "type": "principled",
    "base_color": {"type": "rgb", "value": [0.8, 0.3, 0.1]},
    "metallic": 0.4,
    "roughness": 0.4,
    "specular": 0.5,
}


def square(size: float = 1.0, z: float = 0.0) -> Mesh:
    """A square that faces +z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * size
    corners[:, 2] = z
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), None, uvs)


def cube(centre: tuple[float, float, float], size: float) -> Mesh:
    """A cube with flat faces."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return Mesh(corners * size / 2 + np.array(centre, np.float32), np.array(faces, np.uint32))


def view(width: int = 16, height: int = 12, **options: Any) -> View:
    """A view from z = 4 towards the origin."""
    return View(look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)), 40.0, width, height, **options)


def wall(radiance: float = 1.0, **options: Any) -> SceneSpec:
    """A grey wall at z = 0 that fills the image, under a constant sky."""
    content = {
        "wall": {"type": "mesh", "mesh": square(20.0), "bsdf": GREY},
        "sky": {"type": "constant", "radiance": radiance},
    }
    return SceneSpec("wall", content, (view(**options),))


def objects(*bsdfs: dict[str, Any], width: int = 24) -> SceneSpec:
    """Cubes of the given materials side by side before nothing, under a constant sky."""
    content: dict[str, Any] = {"sky": {"type": "constant"}}
    for i, bsdf in enumerate(bsdfs):
        x = (i - (len(bsdfs) - 1) / 2) * 2.4 / len(bsdfs)
        content[f"cube{i}"] = {"type": "mesh", "mesh": cube((x, 0, 0), 1.6 / len(bsdfs)), "bsdf": bsdf}
    return SceneSpec("objects", content, (view(width, 8),))


def box(width: int = 16, height: int = 16) -> SceneSpec:
    """A room with a lamp, a rough gold cube, a mirror, a glass ball, coated and principled things."""
    white = {"type": "twosided", "inner": GREY}
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.1, 0.1]}}
    checks = np.tile(np.array([[0.2, 0.7], [0.7, 0.2]], np.float32), (4, 4))[..., None].repeat(3, -1)
    floor = {"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": picture(checks)}
    content: dict[str, Any] = {
        "back": {"type": "mesh", "mesh": square(2.0, -1.0), "bsdf": white},
        "floor": {"type": "rectangle", "to_world": turned(0, -1, 90) * 1.0, "bsdf": floor},
        "left": {"type": "rectangle", "to_world": turned(1, -1, 90), "bsdf": red},
        "gold": {"type": "mesh", "mesh": cube((0.5, -0.6, 0.2), 0.7), "bsdf": GOLD},
        "paint": {"type": "mesh", "mesh": cube((-0.5, -0.7, -0.3), 0.5), "bsdf": PRINCIPLED},
        "glass": {
            "type": "sphere",
            "center": [-0.2, 0.3, 0.4],
            "radius": 0.35,
            "bsdf": {"type": "dielectric"},
        },
        "mirror": {"type": "sphere", "center": [0.5, 0.4, 0.0], "radius": 0.3, "bsdf": {"type": "conductor"}},
        "shiny": {"type": "sphere", "center": [-0.8, 0.5, 0.0], "radius": 0.2, "bsdf": {"type": "plastic"}},
        "lamp": {"type": "sphere", "center": [0.0, 2.0, 1.5], "radius": 0.5, "emitter": lamp(8.0)},
        "sky": {"type": "constant", "radiance": 0.3},
    }
    return SceneSpec("box", content, (view(width, height, aperture=0.05, focus=4.0),))


def lamp(radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": [radiance] * 3}}


def picture(pixels: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "picture": Picture(pixels), "filter_type": "nearest"}


def turned(axis: int, place: float, degrees: float) -> np.ndarray:
    """A 2x2 rectangle that faces +z, turned about x (0) or y (1), displaced along that normal."""
    angle = np.radians(-degrees if axis == 0 else degrees)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    if axis == 0:
        matrix[1:3, 1:3] = [[c, -s], [s, c]]
        matrix[1, 3] = place
    else:
        matrix[0, 0], matrix[0, 2], matrix[2, 0], matrix[2, 2] = c, s, -s, c
        matrix[0, 3] = place
    return matrix


def moving(displacement: tuple[float, float, float] = (0.6, 0.0, 0.0), frames: int = 2) -> SceneSpec:
    """A glowing cube that moves to the right of the world before a grey wall; no other light."""
    content = {
        "wall": {"type": "mesh", "mesh": square(20.0, -1.0), "bsdf": GREY},
        "cube": {"type": "mesh", "mesh": cube((0, 0, 0), 0.8), "bsdf": GREY, "emitter": lamp(2.0)},
    }
    return SceneSpec("moving", content, (view(),) * frames, {"cube": displacement}, path=frames > 1)


@functools.cache
def activate() -> Variant:
    """Make the fastest variant of this machine that of the test process."""
    variant = choose()
    variants.activate(variant, threads=2)
    return variant


def few(samples: int) -> int:
    """As many samples as the variant makes in acceptable time."""
    return samples if activate().name == "llvm_ad_rgb" else max(4, samples // 64)


def trace(spec: SceneSpec, *names: str, spp: int = 16, **options: Any) -> dict[str, np.ndarray]:
    """All samples of a small image: name → (S, H, W, C)."""
    activate()
    frame, seed = options.pop("frame", 0), options.pop("seed", 1)
    chunks = list(Tracer(spec).trace(frame, spp, seed, names, **options))
    return {name: np.concatenate([c.values[name] for c in chunks]) for name in names}
