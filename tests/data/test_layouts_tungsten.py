import json

import numpy as np
import pytest

from data.derive import derive
from data.layouts import tungsten
from tests.data.layout_miniatures import kpcn, shot, write_one
from tests.data.layout_miniatures import tungsten as miniature


def test_every_output_with_its_halves_and_variance_is_read(tmp_path):
    scene = tungsten.describe(miniature(tmp_path))[0]
    frame, made = scene.read(0), shot(100, spp=64)
    assert (scene.name, scene.indices, scene.sequence, scene.depth) == ("kitchen", (0,), False, "euclidean")
    for name in ("color", "depth", "visibility"):
        for ending, part in (("", ""), ("_a", "A"), ("_b", "B"), ("_variance", "Variance")):
            expected = made[f"{name}{part}"]
            if part not in ("A", "B"):
                expected = np.maximum(expected, 0)
            assert np.array_equal(frame.buffers[name + ending], expected), name + ending
    assert np.array_equal(frame.buffers["diffuse_albedo_a"], made["albedoA"])
    assert frame.buffers["normal_variance"].shape == (20, 24, 3)
    assert np.array_equal(frame.buffers["reference"], made["converged_color"])


def test_samples_per_pixel_come_from_the_scene_file_and_it_is_said(tmp_path):
    root = miniature(tmp_path)
    frame = tungsten.describe(root)[0].read(0)
    assert frame.spp == 64
    assert frame.notes["assumed"] == {"spp": "64, from the scene file"}


@pytest.mark.parametrize("text", ["{", "[]", '{"renderer": {"spp": "many"}}', '{"renderer": {"spp": -4}}'])
def test_a_scene_file_that_does_not_say_is_no_error(tmp_path, text):
    root = miniature(tmp_path)
    (root / "kitchen" / "scene.json").write_text(text)
    assert tungsten.describe(root)[0].read(0).spp is None


def test_without_the_mean_a_buffer_is_that_of_its_halves(tmp_path):
    root, made = miniature(tmp_path), shot(100, spp=64)
    for name in ("color", "normal"):
        (root / "kitchen" / f"{name}.exr").unlink()
    frame = tungsten.describe(root)[0].read(0)
    assert np.allclose(frame.buffers["color"], (made["colorA"] + made["colorB"]) / 2, rtol=1e-6)
    assert frame.notes["derived"] == {
        "color": "mean of color_a and color_b",
        "normal": "mean of normal_a and normal_b",
    }


def test_a_missing_half_follows_from_the_mean_and_the_other(tmp_path):
    root = miniature(tmp_path)
    (root / "kitchen" / "colorB.exr").unlink()
    frame = derive(tungsten.describe(root)[0].read(0), ["color_b"])
    good = shot(100, spp=64)["color"].min(-1) >= 0
    assert np.allclose(frame.buffers["color_b"][good], shot(100, spp=64)["colorB"][good], atol=1e-4)


def test_without_color_it_is_named_with_what_is_there(tmp_path):
    root = miniature(tmp_path)
    for part in ("", "B"):
        (root / "staircase" / f"color{part}.exr").unlink()
    message = (
        r"staircase: missing buffer 'color' \(color\.exr of frame 0, or diffuse and specular\); found albedo"
    )
    with pytest.raises(ValueError, match=message):
        tungsten.describe(root)


def test_the_renderers_default_output_is_the_color_where_no_other_is_there(tmp_path):
    root = miniature(tmp_path, reference=False)
    for path in (root / "kitchen").glob("color*.exr"):
        path.unlink()
    write_one(root / "kitchen" / "TungstenRender.exr", shot(1)["converged_color"])
    write_one(root / "staircase" / "TungstenRender.exr", shot(1)["converged_color"])
    kitchen, staircase = (scene.read(0) for scene in tungsten.describe(root))
    assert np.array_equal(kitchen.buffers["color"], shot(1)["converged_color"])
    assert not np.array_equal(staircase.buffers["color"], shot(1)["converged_color"])
    assert "reference" not in kitchen.buffers


def test_numbered_outputs_are_a_sequence(tmp_path):
    for number in (3, 4, 5):
        for output in ("color", "colorA", "colorB", "normal"):
            base, half = (output[:-1], output[-1]) if output[-1] in "AB" else (output, "")
            write_one(tmp_path / "s" / f"{base}{number}{half}.exr", shot(number)[output])
        write_one(tmp_path / "s" / f"gt{number}.exr", shot(number)["converged_color"])
    scene = tungsten.describe(tmp_path)[0]
    assert (scene.indices, scene.sequence) == ((3, 4, 5), True)
    assert np.array_equal(scene.read(4).buffers["color_a"], shot(4)["colorA"])
    assert np.array_equal(scene.read(5).buffers["reference"], shot(5)["converged_color"])


@pytest.mark.parametrize(("lost", "named"), [("normal4", "'normal'"), ("gt4", "'reference'")])
def test_a_frame_that_lacks_what_others_have_is_named(tmp_path, lost, named):
    for number in (3, 4):
        for output in ("color", "normal"):
            write_one(tmp_path / "s" / f"{output}{number}.exr", shot(number)[output])
        write_one(tmp_path / "s" / f"gt{number}.exr", shot(number)["converged_color"])
    (tmp_path / "s" / f"{lost}.exr").unlink()
    with pytest.raises(ValueError, match=rf"missing buffer {named} of frame 4, which other frames have"):
        tungsten.describe(tmp_path)


def test_the_root_may_be_the_scene_itself(tmp_path):
    root = miniature(tmp_path)
    assert [s.name for s in tungsten.describe(root / "kitchen")] == ["kitchen"]
    assert tungsten.likeness(root / "kitchen") == tungsten.likeness(root) == 1


def test_another_layout_is_refused_and_named(tmp_path):
    kpcn(tmp_path)
    with pytest.raises(ValueError, match="no scene of the layout `tungsten` found"):
        tungsten.describe(tmp_path)


def test_a_scene_file_of_absurd_depth_is_no_error(tmp_path):
    root = miniature(tmp_path)
    (root / "kitchen" / "scene.json").write_text("[" * 200_000)
    assert tungsten.describe(root)[0].read(0).spp is None


def test_two_scene_files_say_nothing(tmp_path):
    root = miniature(tmp_path)
    (root / "kitchen" / "other.json").write_text(json.dumps({"renderer": {"spp": 8}}))
    assert tungsten.describe(root)[0].read(0).spp is None
