import pickle

import h5py
import numpy as np
import pytest

from data.exr import read_exr, write_exr
from data.layouts import afgsa, afgsa_patches
from tests.data.layout_miniatures import (
    afgsa_folders,
    afgsa_h5,
    afgsa_merged,
    patch_arrays,
    shot,
)


def test_shots_of_the_folders_are_views_of_their_scene(tmp_path):
    scenes = afgsa.describe(afgsa_folders(tmp_path))
    assert [(s.name, s.indices, s.sequence, s.depth) for s in scenes] == [
        ("bathroom2", (0, 1), False, "euclidean"),
        ("room3", (0, 1), False, "euclidean"),
    ]
    frame, made = scenes[1].read(1), shot(41)
    assert (frame.spp, frame.notes["reference_spp"], frame.notes["view"]) == (32, 32768, 1)
    assert np.array_equal(frame.buffers["color"], np.maximum(made["color"], 0))
    assert np.array_equal(frame.buffers["diffuse_albedo"], made["albedo"])
    assert np.array_equal(frame.buffers["reference"], made["converged_color"])
    assert "normalised" not in frame.notes


def test_scene_names_may_have_underscores(tmp_path):
    afgsa_folders(tmp_path, ("living_room_2",), 1)
    assert [s.name for s in afgsa.describe(tmp_path)] == ["living_room_2"]


@pytest.mark.parametrize("role", ["normal", "depth", "albedo"])
def test_a_missing_file_of_a_shot_is_named(tmp_path, role):
    (afgsa_folders(tmp_path) / "32spp" / f"room3_1_32_{role}.exr").unlink()
    message = rf"32spp: missing buffer '\w+' \({role}\.exr of room3_1\); found room3_1_32_color\.exr"
    with pytest.raises(ValueError, match=message):
        afgsa.describe(tmp_path)


def test_a_shot_without_reference_or_without_input_is_named(tmp_path):
    for path in afgsa_folders(tmp_path).glob("32768spp/room3_1_*"):
        path.unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'reference' \(color\.exr of room3_1 "):
        afgsa.describe(tmp_path)
    for path in afgsa_folders(tmp_path).glob("32spp/room3_0_*"):
        path.unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'color' \(room3_0 has a reference only\)"):
        afgsa.describe(tmp_path)


def test_the_color_of_a_shot_is_the_sum_of_its_parts_where_it_has_none(tmp_path):
    afgsa_folders(tmp_path)
    (tmp_path / "32spp" / "room3_0_32_color.exr").unlink()
    frame = afgsa.describe(tmp_path)[1].read(0)
    assert frame.notes["derived"]["color"] == "diffuse + specular"
    assert np.array_equal(frame.buffers["color"], frame.buffers["diffuse"] + frame.buffers["specular"])


def test_built_patches_keep_the_names_of_their_files_as_scenes(tmp_path):
    scenes = afgsa.describe(afgsa_h5(tmp_path))
    assert [(s.name, s.indices, s.sequence) for s in scenes] == [
        (name, (0, 1, 2), False) for name in ("train", "val", "test_4")
    ]


def test_a_patch_has_its_raw_normal_and_its_depth_is_said_to_be_normalised(tmp_path):
    frame = afgsa.describe(afgsa_h5(tmp_path, 3, ("train",), 128))[0].read(2)
    arrays = patch_arrays(3, 128)
    for name, key in (
        ("color", "noisy"),
        ("reference", "gt"),
        ("diffuse", "diff"),
        ("reference_diffuse", "diff_gt"),
    ):
        assert np.array_equal(frame.buffers[name], np.maximum(arrays[key][2], 0)), name
    aux = arrays["aux"][2]
    assert np.array_equal(frame.buffers["normal"], np.nan_to_num(aux[..., :3]))
    assert np.array_equal(frame.buffers["depth"], aux[..., 3:4])
    assert np.array_equal(frame.buffers["diffuse_albedo"], aux[..., 4:])
    assert frame.notes["normalised"] == ["depth"]
    assert (frame.spp, frame.notes["reference_spp"]) == (32, 32768)


def test_test_patches_have_the_samples_of_their_name_and_an_unknown_reference(tmp_path):
    frame = afgsa.describe(afgsa_h5(tmp_path, files=("test_4", "test_128")))[1].read(0)
    assert (frame.scene, frame.spp) == ("test_128", 128)
    assert "reference_spp" not in frame.notes


def test_patches_are_read_a_block_at_a_time_and_never_the_whole_data_set(tmp_path, monkeypatch):
    afgsa_h5(tmp_path, 6, ("train",))
    with h5py.File(tmp_path / "train.h5", "r+") as file:
        for key in list(file):
            array = file[key][...]
            del file[key]
            file.create_dataset(key, data=array, compression="gzip", chunks=(2, 16, 16, array.shape[-1]))
    asked = []
    monkeypatch.setattr(
        afgsa_patches, "items", lambda source, *span: (asked.append(span), source[slice(*span)])[1]
    )
    scene = afgsa.describe(tmp_path)[0]
    for index in (2, 3):
        assert np.array_equal(scene.read(index).buffers["reference"], patch_arrays(6)["gt"][index])
    assert set(asked) == {(2, 4)}
    assert len(asked) == 6


def test_scenes_can_be_sent_to_other_processes(tmp_path):
    for make in (afgsa_folders, afgsa_h5, afgsa_merged):
        scene = pickle.loads(pickle.dumps(afgsa.describe(make(tmp_path / make.__name__))[0]))
        assert scene.read(0).buffers["reference"].shape[2] == 3
        assert len(pickle.dumps(scene.read)) < 1000


def test_files_of_patches_without_aux_or_of_other_length_are_named(tmp_path):
    afgsa_h5(tmp_path, 2, ("train",))
    with h5py.File(tmp_path / "train.h5", "r+") as file:
        del file["gt"]
        file.create_dataset("gt", data=patch_arrays(1)["gt"])
    with pytest.raises(ValueError, match=r"train\.h5: data set 'gt' is \(1, 32, 32, 3\), but 'noisy' is"):
        afgsa.describe(tmp_path)
    with h5py.File(tmp_path / "train.h5", "r+") as file:
        del file["aux"]
    message = (
        r"train\.h5: missing data set 'aux' \(normal, depth and albedo\); found diff, diff_gt, gt, noisy"
    )
    with pytest.raises(ValueError, match=message):
        afgsa.describe(tmp_path)


def test_links_out_of_a_file_of_patches_are_refused(tmp_path):
    afgsa_h5(tmp_path, 2, ("train", "val"))
    with h5py.File(tmp_path / "val.h5", "r+") as file:
        del file["gt"]
        file["gt"] = h5py.ExternalLink("train.h5", "/gt")
    with pytest.raises(ValueError, match=r"val\.h5: data set 'gt' is a link to another file"):
        afgsa.describe(tmp_path)


def test_an_inference_file_finds_its_reference_by_its_name(tmp_path):
    scenes = afgsa.describe(afgsa_merged(tmp_path))
    assert [(s.name, s.indices) for s in scenes] == [("bathroom", (0,)), ("veach-ajar", (0,))]
    bathroom, ajar = (s.read(0) for s in scenes)
    assert (bathroom.spp, ajar.spp) == (32, None)
    assert np.array_equal(bathroom.buffers["reference"], shot(71)["converged_color"])
    assert np.array_equal(ajar.buffers["diffuse_albedo"], shot(70)["albedo"])


def test_an_inference_file_without_depth_names_the_channels_found(tmp_path):
    path = afgsa_merged(tmp_path) / "veach-ajar.exr"
    write_exr(path, {c: v for c, v in read_exr(path).channels.items() if c != "depth.Z"})
    with pytest.raises(
        ValueError, match=r"missing buffer 'depth' \(channels depth\.\*\); found B, G, R, albedo"
    ):
        afgsa.describe(tmp_path)


def test_an_inference_file_without_reference_is_read_alone(tmp_path):
    (afgsa_merged(tmp_path, ("veach-ajar",)) / "veach-ajar_gt.exr").unlink()
    assert "reference" not in afgsa.describe(tmp_path)[0].read(0).buffers


def test_patches_beside_the_frames_they_were_cut_from_are_refused(tmp_path):
    afgsa_h5(afgsa_folders(tmp_path), 1)
    with pytest.raises(ValueError, match="holds folders of frames and built patches; name the folder of one"):
        afgsa.describe(tmp_path)


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(
        ValueError, match="nothing of the layout `afgsa` found, expected 32spp/<scene>_<shot>"
    ):
        afgsa.describe(tmp_path)
