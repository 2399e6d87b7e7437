from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from data.render.materials import GLASS, OPAQUE, random_material, surface_material
from data.render.spec import Picture
from data.render.textures import BRIGHTEST, random_texture

KINDS = [*OPAQUE, *GLASS]


def drawn(kind: str, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return random_material(rng, lambda: random_texture(rng), kind=kind)


def leaves(plugin: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in plugin.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{k}", v) for k, v in leaves(value))
        else:
            yield key, value


@pytest.mark.parametrize("kind", KINDS)
def test_no_colour_is_brighter_than_real_ones(kind: str) -> None:
    for seed in range(6):
        for name, value in leaves(drawn(kind, seed)):
            if name.endswith(".value"):
                assert 0 <= min(value) <= max(value) <= BRIGHTEST, name
            if isinstance(value, Picture):
                assert value.pixels.max() <= BRIGHTEST + 1e-6, name


@pytest.mark.parametrize("kind", OPAQUE)
def test_opaque_materials_show_both_sides(kind: str) -> None:
    assert drawn(kind, 0)["type"] == "twosided"


def test_glass_is_drawn_only_when_asked_for() -> None:
    rng = np.random.default_rng(0)

    def texture() -> Picture:
        return Picture(np.full((2, 2, 3), 0.5, np.float32))

    opaque = {random_material(rng, texture)["type"] for _ in range(60)}
    glass = {random_material(rng, texture, glass=True)["type"] for _ in range(20)}
    assert opaque == {"twosided"}
    assert glass == {"dielectric", "roughdielectric"}


def test_all_kinds_and_textured_roughness_are_drawn() -> None:
    rng = np.random.default_rng(0)

    def texture() -> Picture:
        return Picture(np.full((2, 2, 3), 0.5, np.float32))

    many = [random_material(rng, texture)["bsdf"] for _ in range(150)]
    expected = {"diffuse", "plastic", "roughplastic", "conductor", "roughconductor", "principled"}
    assert {m["type"] for m in many} == expected
    pictures = [name for m in many for name, value in leaves(m) if isinstance(value, Picture)]
    assert {"alpha.picture", "roughness.picture", "base_color.picture", "reflectance.picture"} <= set(
        pictures
    )


def test_surfaces_of_rooms_are_never_metal() -> None:
    rng = np.random.default_rng(0)
    kinds = {
        surface_material(rng, lambda: random_texture(rng, "gradient"))["bsdf"]["type"] for _ in range(40)
    }
    assert kinds == {"diffuse", "roughplastic", "principled"}


_LOAD = """
import json
import numpy as np
import mitsuba as mi
mi.set_variant("scalar_rgb")
from data.render.loading import load
from data.render.materials import GLASS, OPAQUE, random_material
from data.render.spec import SceneSpec
from data.render.textures import random_texture
radiance = {}
for number, kind in enumerate([*OPAQUE, *GLASS]):
    for seed in range(3):
        rng = np.random.default_rng(100 * number + seed)
        bsdf = random_material(rng, lambda: random_texture(rng), kind=kind)
        content = {
            "ball": {"type": "sphere", "bsdf": bsdf},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        }
        scene = load(SceneSpec(f"{kind}-{seed}", content, ())).scene
        sensor = mi.load_dict({
            "type": "perspective", "fov": 30.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, -5], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        })
        path = mi.load_dict({"type": "path", "max_depth": 4})
        image = np.array(mi.render(scene, integrator=path, sensor=sensor, spp=16))
        radiance[f"{kind}-{seed}"] = [float(image[3:5, 3:5].mean()), bool(np.isfinite(image).all())]
print(json.dumps(radiance))
"""


def test_every_kind_loads_and_reflects_no_more_than_it_receives() -> None:
    done = subprocess.run([sys.executable, "-c", _LOAD], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    measured = json.loads(done.stdout)
    assert len(measured) == 3 * len(KINDS)
    for name, (radiance, finite) in measured.items():
        assert finite, name
        # Under a white sky of radiance 1; sheen of the principled model may add a little.
        assert 0.005 < radiance < 1.15, name
