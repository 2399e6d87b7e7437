import json
from pathlib import Path

import numpy as np
import pytest

from data.layouts import likeliest, penumbra
from tests.data.miniature import penumbra_scene, sample_crop

SHARED = Path(__file__).parents[3] / "shared" / "dataset"


def edit(folder, change):
    path = folder / "sequence.json"
    sidecar = json.loads(path.read_text())
    change(sidecar)
    path.write_text(json.dumps(sidecar))


def test_a_video_has_reflectances_camera_exposure_and_reference(tmp_path):
    penumbra_scene(tmp_path, "classroom")
    scene = penumbra.describe(tmp_path)[0]
    assert (scene.name, scene.indices, scene.sequence, scene.depth) == (
        "classroom",
        (0, 1),
        True,
        "euclidean",
    )
    frame = scene.read(1)
    original = sample_crop("classroom", 1)
    assert np.array_equal(frame.buffers["color"], original.buffers["color"])
    assert np.array_equal(frame.buffers["reference"], original.buffers["reference"])
    assert {"diffuse_albedo", "specular_albedo", "motion"} <= frame.buffers.keys()
    assert not {"albedo", "specular"} & frame.buffers.keys()
    assert (frame.spp, frame.exposure) == (1, original.exposure)
    assert frame.camera.centre() == pytest.approx(original.camera.centre())


def test_the_lens_is_that_of_the_sidecar_and_a_pinhole_has_no_focus(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    (scene,) = penumbra.describe(tmp_path)
    assert scene.read(0).thin_lens is None
    edit(folder, lambda s: s["frames"][0]["camera"].update(fov_x_degrees=39.0, focus_distance=2.5))
    assert scene.read(0).thin_lens == (0.0, 0.0, 39.0)
    edit(folder, lambda s: s["frames"][0]["camera"].update(aperture_radius=0.125))
    assert scene.read(0).thin_lens == (0.125, 2.5, 39.0)
    edit(folder, lambda s: s["frames"][0]["camera"].update(aperture_radius="wide"))
    with pytest.raises(ValueError, match=r"sequence\.json, frame 0: camera"):
        scene.read(0)


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared data set")
def test_shared_layer_frames_have_their_lens():
    scenes = {scene.name: scene for scene in penumbra.describe(SHARED / "layers")}
    assert scenes["cbox-glossy"].read(0).thin_lens == pytest.approx((0.118466, 2.961646, 39.0), abs=1e-6)
    assert scenes["veach-lamp"].read(0).thin_lens[:2] == (0, 0)


def test_stills_have_halves_and_variances_and_are_no_sequence(tmp_path):
    penumbra_scene(tmp_path, "classroom", kind="stills")
    scene = penumbra.describe(tmp_path)[0]
    frame = scene.read(0)
    assert not scene.sequence
    assert frame.spp == 32
    assert {"color_a", "color_b", "color_variance", "diffuse"} <= frame.buffers.keys()


def test_albedo_is_reflectance_here_even_if_it_is_nowhere_zero(tmp_path):
    penumbra_scene(tmp_path, "classroom")
    frame = next(penumbra.frames(tmp_path))
    assert frame.buffers["diffuse_albedo"].min() > 0


def test_a_scene_folder_can_be_the_root(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    assert [s.name for s in penumbra.describe(folder)] == ["classroom"]
    assert likeliest(tmp_path) == likeliest(folder) == "penumbra"


def test_frames_without_reference_are_read_without_it(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    (folder / "f000_reference.exr").unlink()
    assert "reference" not in penumbra.read(folder, 0).buffers


def test_a_listed_frame_without_file_is_named(tmp_path):
    (penumbra_scene(tmp_path, "classroom") / "f001_input.exr").unlink()
    with pytest.raises(ValueError, match=r"lists frame 1, but f001_input\.exr is missing"):
        penumbra.describe(tmp_path)


def test_a_file_that_the_sidecar_does_not_describe_is_named(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    edit(folder, lambda s: s["frames"].pop())
    with pytest.raises(ValueError, match=r"sequence\.json: frame 1 is not described, but its file exists"):
        penumbra.describe(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"frames": 3}'])
def test_a_damaged_sidecar_is_named(tmp_path, text):
    (penumbra_scene(tmp_path, "classroom") / "sequence.json").write_text(text)
    with pytest.raises(ValueError, match=r"sequence\.json is damaged"):
        penumbra.describe(tmp_path)


def test_a_wrong_camera_or_exposure_is_named_with_its_frame(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    edit(folder, lambda s: s["frames"][0]["camera"].update(world_to_pixel=[[1]]))
    edit(folder, lambda s: s["frames"][1]["reference"].update(exposure=-1))
    with pytest.raises(ValueError, match=r"sequence\.json, frame 0: camera matrix"):
        penumbra.read(folder, 0)
    with pytest.raises(ValueError, match=r"sequence\.json, frame 1: exposure -1, expected > 0"):
        penumbra.read(folder, 1)


def test_a_frame_without_exposure_leaves_it_unknown(tmp_path):
    folder = penumbra_scene(tmp_path, "classroom")
    edit(folder, lambda s: s["frames"][0].pop("reference"))
    assert penumbra.read(folder, 0).exposure is None


def test_a_folder_without_scenes_is_refused(tmp_path):
    (tmp_path / "x").mkdir()
    with pytest.raises(ValueError, match="no scene of the layout `penumbra` found"):
        penumbra.describe(tmp_path)


@pytest.mark.shared
@pytest.mark.parametrize(("kind", "scenes", "frames"), [("video", 4, 48), ("stills", 10, 17)])
def test_the_development_data_is_read_whole(kind, scenes, frames):
    if not SHARED.is_dir():
        pytest.skip("no development data")
    found = penumbra.describe(SHARED / kind)
    assert (len(found), sum(len(s.indices) for s in found)) == (scenes, frames)
    for scene in found:
        assert "reference" in scene.read(scene.indices[-1]).buffers
