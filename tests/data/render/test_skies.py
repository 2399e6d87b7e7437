from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from data.render.skies import (
    GREY,
    HEIGHT,
    KINDS,
    WIDTH,
    add_sun,
    directions,
    disc,
    ground_level,
    random_sky,
    scaled,
    solid_angles,
    sphere_level,
)
from data.render.spec import Picture


@pytest.mark.parametrize("kind", KINDS)
def test_sky_is_finite_varied_and_as_bright_as_asked(kind: str) -> None:
    pixels = random_sky(np.random.default_rng(0), 0.25, kind).pixels
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert pixels.dtype == np.float32
    assert np.isfinite(pixels).all()
    assert pixels.min() >= 0
    assert pixels.std() > 1e-3
    level = (ground_level(pixels) + sphere_level(pixels)) / 2
    assert level == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_same_generator_state_gives_the_same_sky(kind: str) -> None:
    first, second = (random_sky(np.random.default_rng(1), 0.2, kind).pixels for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("kind", KINDS)
def test_no_light_is_smaller_than_a_disc_of_two_degrees(kind: str) -> None:
    pixels = random_sky(np.random.default_rng(2), 0.2, kind).pixels.mean(-1)
    weight = pixels * solid_angles()
    bright = pixels > 0.5 * pixels.max()
    smallest = 2 * np.pi * (1 - np.cos(np.radians(1.0)))
    assert (bright * solid_angles()).sum() > 0.8 * smallest
    assert np.isfinite(weight).all()


def test_all_kinds_are_drawn() -> None:
    assert len(KINDS) == 8
    suns = [random_sky(np.random.default_rng(s), 0.2).pixels for s in range(7)]
    peaks = [p.max() / np.median(p) for p in suns]
    assert min(peaks) < 20
    assert max(peaks) > 100


def test_solid_angles_cover_the_sphere() -> None:
    assert solid_angles().sum() * WIDTH == pytest.approx(4 * np.pi)


def test_level_of_a_uniform_environment_is_its_radiance_times_the_reflectance() -> None:
    assert ground_level(np.ones((64, 128, 3))) == pytest.approx(GREY, rel=1e-3)
    assert sphere_level(np.ones((64, 128, 3))) == pytest.approx(GREY, rel=1e-3)
    assert scaled(np.ones((64, 128, 3)), 0.8).pixels.mean() == pytest.approx(2.0, rel=1e-3)


def test_disc_has_the_solid_angle_of_its_diameter() -> None:
    way = directions()
    for elevation in (10, 45, 80):
        e = np.radians(elevation)
        cover = disc(way, np.array([0.0, np.sin(e), -np.cos(e)]), 4.0)
        expected = 2 * np.pi * (1 - np.cos(np.radians(2.0)))
        assert (cover * solid_angles()).sum() == pytest.approx(expected, rel=0.06)


def test_sun_gives_the_asked_share_of_the_irradiance_of_the_sky() -> None:
    sky = np.ones((HEIGHT, WIDTH, 3))
    up = np.array([0.0, 1.0, 0.0])
    lit = add_sun(sky, up, 3.0, np.array([1.0, 0.8, 0.6]), 4.0)
    assert ground_level(lit) == pytest.approx(5 * ground_level(sky), rel=1e-2)
    ratio = (lit - sky).reshape(-1, 3).max(0)
    assert ratio[2] / ratio[0] == pytest.approx(0.6)


_PROBE = """
import json, sys
import numpy as np
import mitsuba as mi
mi.set_variant("scalar_rgb")
from data.render.skies import directions
way = directions(16, 32)
answers = []
for row, column in json.loads(sys.argv[1]):
    pixels = np.full((16, 32, 3), 0.01, np.float32)
    pixels[row, column] = 1
    sky = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(pixels)})
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*(-way[row, column]))
    answers.append(float(sky.eval(si)[0]))
print(json.dumps(answers))
"""


def test_directions_are_those_of_the_renderer() -> None:
    pixels = [[3, 5], [8, 0], [8, 8], [8, 24], [12, 17]]
    done = subprocess.run(
        [sys.executable, "-c", _PROBE, json.dumps(pixels)], capture_output=True, text=True, check=True
    )
    np.testing.assert_allclose(json.loads(done.stdout), 1, atol=1e-3)


def test_sky_is_no_raw_picture() -> None:
    assert isinstance(random_sky(np.random.default_rng(0), 0.2, "gradient"), Picture)
    assert not random_sky(np.random.default_rng(0), 0.2, "gradient").raw
