import numpy as np
import pytest

from data.derive import derive
from data.frames import FrameSet
from data.render.references import ENERGY_LIMIT
from data.sample import FOLDER, SAMPLES
from data.sample.rendered import LIMIT_BYTES, RECIPES, SEEDS, TEST


@pytest.fixture(params=sorted(RECIPES))
def rendered(request):
    return request.param, FrameSet(SAMPLES[request.param])


def frames(frame_set):
    return [
        (frame_set.read(scene, record.index), record)
        for scene in frame_set.scenes()
        for record in frame_set.frames(scene)
    ]


def test_rendered_samples_match_their_manifest_and_recipe(rendered):
    name, frame_set = rendered
    assert frame_set.check() == []
    recipe = frame_set.manifest.recipe["recipe"]
    assert recipe == RECIPES[name].to_json()
    assert frame_set.scenes("test") == list(TEST[name])
    assert len(frame_set.scenes()) == len(SEEDS[name])


def test_rendered_samples_have_at_most_twenty_megabytes():
    size = sum(p.stat().st_size for name in RECIPES for p in (FOLDER / name).rglob("*"))
    assert size <= LIMIT_BYTES


def test_noisy_means_agree_with_their_references(rendered):
    _, frame_set = rendered
    for frame, record in frames(frame_set):
        assert abs(record.checks["energy_z"]) < ENERGY_LIMIT, frame.label
        ratio = frame.buffers["color"].mean() / frame.buffers["reference"].mean()
        assert 0.7 < ratio < 1.4, frame.label


def test_every_scene_is_cc0_and_says_how_to_make_it_again(rendered):
    _, frame_set = rendered
    for scene in frame_set.manifest.scenes.values():
        assert scene.license == "CC0-1.0"
        assert {"generator", "version", "seed", "kind"} <= scene.origin.keys()


def test_stills_have_what_trained_and_training_free_methods_need():
    for frame, record in frames(FrameSet(SAMPLES["stills"])):
        assert (record.spp, record.reference_spp) == (32, 256)
        for name in ("color", "normal", "diffuse_albedo", "depth"):
            assert {f"{name}_a", f"{name}_b", f"{name}_variance"} <= frame.buffers.keys()
        assert {"diffuse", "specular_variance", "visibility", "reference_diffuse"} <= frame.buffers.keys()
        split = derive(frame, ["specular"])
        assert (split.buffers["specular"] >= 0).all()
        normal = np.linalg.norm(frame.buffers["normal"], axis=-1)
        assert normal.max() < 1.001


def test_layers_keep_eight_samples_with_twenty_numbers_apart():
    for frame, record in frames(FrameSet(SAMPLES["layers"])):
        assert (frame.samples.count, len(frame.samples.channels), record.spp) == (8, 20, 8)
        mean = frame.samples.get("radiance").mean(0)
        assert np.allclose(mean, frame.buffers["color"], rtol=0.02, atol=1e-3)
        assert frame.samples.get("diffuse_albedo").max() <= 1
        lengths = np.linalg.norm(frame.samples.get("normal"), axis=-1)
        hit = frame.samples.get("depth")[..., 0] > 0
        assert np.abs(lengths[hit] - 1).max() < 0.02
