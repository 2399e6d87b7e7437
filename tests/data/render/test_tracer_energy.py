"""The samples' mean is what Mitsuba's own path integrator renders, in every mode."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data.render import loading
from data.render.spec import SceneSpec
from tests.data.render import scenes

PASSES = 48


def interval(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of the RGB mean of independent images (N, H, W, 3)."""
    means = images.astype(np.float64).mean((1, 2))
    return means.mean(0), means.std(0, ddof=1) / np.sqrt(len(means))


@pytest.fixture(scope="module")
def expected():
    """What Mitsuba renders of the box: mean and standard error."""
    scenes.activate()
    import mitsuba

    spec = scenes.box()
    scene = loading.load(spec).scene
    sensor = loading.sensor(spec.views[0])
    path = mitsuba.load_dict({"type": "path", "max_depth": 8})
    spp = scenes.few(256)
    images = [
        np.array(mitsuba.render(scene, sensor=sensor, integrator=path, spp=spp, seed=i))
        for i in range(PASSES)
    ]
    return interval(np.stack(images))


def agrees(found, wanted) -> bool:
    (mean, error), (other, other_error) = found, wanted
    return bool((np.abs(mean - other) <= 4.0 * np.sqrt(error**2 + other_error**2)).all())


@pytest.mark.parametrize(
    "names", [("radiance",), ("radiance", "normal"), ("radiance", "diffuse", "visibility")], ids="+".join
)
def test_the_mean_radiance_is_that_of_mitsuba_s_path_integrator(expected, names):
    values = scenes.trace(scenes.box(), *names, spp=scenes.few(2048))
    mean, error = interval(values["radiance"])
    assert (error < 0.05 * mean).all()
    assert agrees((mean, error), expected)


def test_the_check_would_notice_the_second_vertex_s_light_counted_twice(expected):
    mean, error = expected
    assert not agrees((mean * 1.05, error), expected)


@pytest.mark.parametrize(
    ("bsdf", "share"),
    [
        (scenes.GREY, (1.0, 1.0)),
        (scenes.GOLD, (0.0, 0.0)),
        ({"type": "conductor"}, (0.0, 0.0)),
        ({"type": "dielectric"}, (0.0, 0.0)),
        ({"type": "roughplastic", "alpha": 0.1}, (0.6, 0.99)),
        ({"type": "plastic"}, (0.6, 0.99)),
        (scenes.PRINCIPLED, (0.2, 0.8)),
    ],
    ids=lambda x: x["type"] if isinstance(x, dict) else "",
)
def test_the_diffuse_part_is_that_of_the_material(bsdf, share):
    spec = scenes.objects(bsdf)
    values = scenes.trace(spec, "radiance", "diffuse", "hit", spp=scenes.few(512))
    hit = values["hit"][..., 0] > 0
    assert (values["diffuse"] <= values["radiance"] + 1e-4).all()
    assert (values["diffuse"][~hit] == values["radiance"][~hit]).all()
    fraction = values["diffuse"][hit].sum(dtype=float) / values["radiance"][hit].sum(dtype=float)
    assert share[0] - 1e-5 <= fraction <= share[1] + 1e-5


def test_the_principled_bsdf_s_diffuse_part_is_the_whole_of_it_without_its_specular_lobe():
    matt = {"type": "principled", "base_color": {"type": "rgb", "value": [0.8, 0.4, 0.2]}, "specular": 0.0}
    values = scenes.trace(scenes.objects(matt), "radiance", "diffuse", "hit", spp=scenes.few(512))
    hit = values["hit"][..., 0] > 0
    fraction = values["diffuse"][hit].sum(dtype=float) / values["radiance"][hit].sum(dtype=float)
    assert 0.9 < fraction <= 1.0 + 1e-5


def test_a_white_furnace_returns_the_albedo():
    wall = scenes.wall()
    values = scenes.trace(wall, "radiance", "diffuse", "visibility", spp=scenes.few(64))
    mean, error = interval(values["radiance"])
    assert (np.abs(mean - 0.6) <= 4 * error + 1e-4).all()
    assert (values["radiance"] == values["diffuse"]).all()


def test_emission_of_the_first_hit_counts_once_and_as_diffuse():
    content = {"lamp": {"type": "mesh", "mesh": scenes.square(20.0), "emitter": scenes.lamp(3.0)}}
    spec = SceneSpec("lamp", content, (scenes.view(),))
    values = scenes.trace(spec, "radiance", "diffuse", "visibility", spp=4)
    assert values["radiance"] == pytest.approx(3.0, rel=1e-5)
    assert values["diffuse"] == pytest.approx(3.0, rel=1e-5)


def test_the_scalar_variant_gives_the_same_guides_and_radiance():
    """In a process of its own, since a process has one variant; whatever this machine's variant is."""
    scenes.activate()
    root = Path(__file__).parents[3]
    child = subprocess.run(
        [sys.executable, "-m", "tests.data.render.scalar_means"], cwd=root, capture_output=True, text=True
    )
    assert child.returncode == 0, child.stderr[-2000:]
    there = dict(line.split("=") for line in child.stdout.split())
    names = ("radiance", "diffuse", "depth", "hit", "second_albedo")
    here = scenes.trace(scenes.box(8, 8), *names, spp=scenes.few(1024))
    for name, values in here.items():
        mean, error = (float(x) for x in there[name].split("/"))
        own = values.astype(np.float64).mean((1, 2, 3))
        own_error = own.std(ddof=1) / np.sqrt(len(own))
        assert abs(own.mean() - mean) <= 4.5 * np.hypot(error, own_error)
    alone, error = (float(x) for x in there["alone"].split("/"))
    own = here["radiance"].astype(np.float64).mean((1, 2, 3))
    assert abs(own.mean() - alone) <= 4.5 * np.hypot(error, own.std(ddof=1) / np.sqrt(len(own)))
