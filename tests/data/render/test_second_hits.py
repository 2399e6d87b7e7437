"""What paths hit second: its reflectance, and that asking for it changes nothing else."""

import numpy as np
import pytest

from data.render.spec import SceneSpec
from tests.data.render import scenes
from tests.data.render.scenes import trace

MIRROR = {"type": "conductor", "material": "none"}
RED = [0.6, 0.1, 0.25]
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}}


def diffuse(colour):
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}}


def facing(bsdf, mirror=MIRROR, **behind):
    """A mirror that fills the right half of the image, and a wall behind the camera that it shows."""
    square = scenes.square(20.0)
    square.vertices[:, 0] = np.where(square.vertices[:, 0] < 0, 0.05, 20)
    content = {
        "mirror": {"type": "mesh", "mesh": square, "bsdf": mirror},
        "behind": {"type": "mesh", "mesh": scenes.square(200.0, 6.0), "bsdf": bsdf, **behind},
        "sky": {"type": "constant", "radiance": 0.5},
    }
    return SceneSpec("facing", content, (scenes.view(),))


@pytest.mark.parametrize(
    ("bsdf", "expected", "tolerance"),
    [
        (diffuse(RED), RED, 0),
        (diffuse([1.0, 1.0, 1.0]), (1, 1, 1), 0),
        ({"type": "twosided", "inner": scenes.GOLD}, (0.967, 0.802, 0.324), 0.03),
        ({"type": "twosided", "inner": {"type": "roughplastic"}}, (0.5387, 0.5387, 0.5387), 1e-3),
        (MIRROR, (1, 1, 1), 0),
    ],
    ids=["red", "white", "gold", "plastic", "mirror"],
)
def test_a_mirror_shows_the_reflectance_of_the_wall_that_it_faces(bsdf, expected, tolerance):
    values = trace(facing(bsdf), "second_albedo", "hit", spp=4)
    hit = values["hit"][..., 0] > 0
    found = values["second_albedo"][hit]
    assert 0.3 < hit.mean() < 0.7
    assert np.abs(found - np.array(expected, np.float32)).max() <= tolerance


def test_paths_that_leave_the_scene_have_no_second_hit():
    values = trace(facing(diffuse(RED)), "second_albedo", "hit", spp=4)
    assert (values["second_albedo"][values["hit"][..., 0] == 0] == 0).all()
    assert (trace(scenes.wall(), "second_albedo", spp=4)["second_albedo"] == 0).all()


def test_black_surfaces_end_paths_before_a_second_hit():
    values = trace(facing(diffuse(RED), BLACK), "second_albedo", "hit", spp=4)
    assert values["hit"].max() == 1
    assert (values["second_albedo"] == 0).all()


def test_a_lamp_counts_with_the_reflectance_of_its_surface():
    values = trace(facing(diffuse(RED), emitter=scenes.lamp(3.0)), "second_albedo", "hit", spp=4)
    found = values["second_albedo"][values["hit"][..., 0] > 0]
    assert (found == np.array(RED, np.float32)).all()


def test_between_walls_of_two_colours_the_mean_is_the_share_of_each():
    """A floor below an infinitely wide ceiling, one half of which is white and the other black."""
    checks = np.array([[1.0, 0.0]], np.float32)[..., None].repeat(3, -1)
    ceiling = scenes.square(200.0, 6.0)
    content = {
        "floor": {"type": "mesh", "mesh": scenes.square(0.5), "bsdf": scenes.GREY},
        "ceiling": {
            "type": "mesh",
            "mesh": ceiling,
            "bsdf": {
                "type": "twosided",
                "inner": {"type": "diffuse", "reflectance": scenes.picture(checks)},
            },
        },
    }
    values = trace(SceneSpec("halves", content, (scenes.view(),)), "second_albedo", "hit", spp=256)
    found = values["second_albedo"][values["hit"][..., 0] > 0]
    # Light of a ceiling of half-width 200 at distance 6 leaves out 0.1 % of the hemisphere.
    error = 0.5 / np.sqrt(len(found))
    assert found.mean() == pytest.approx(0.5, abs=4 * error + 1e-3)
    assert np.isin(found, (0, 1)).all()


@pytest.mark.parametrize("make", [scenes.box, scenes.moving], ids=["still", "moving"])
def test_other_quantities_are_the_same_bits_with_and_without_it(make):
    names = ("radiance", "diffuse", "visibility", "normal", "position", "specular_albedo", "roughness")
    without = trace(make(), *names, spp=8)
    with_it = trace(make(), *names, "second_albedo", spp=8)
    for name in names:
        assert np.array_equal(with_it[name], without[name])
    assert with_it["second_albedo"].max() > 0
