import pickle

import numpy as np
import pytest

from data.derive import derive
from data.exr import write_exr
from data.frames import FrameSet
from data.layouts import blender, likeliest
from data.layouts.twins import scenes_of
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_samples import RGB, blender_channels, blender_file, half, lettered, picture
from trainer.cli import main


def one(tmp_path, channels, **attributes):
    """Write one file and read its frame."""
    write_exr(tmp_path / "s" / "0001.exr", channels, attributes)
    return next(blender.frames(tmp_path))


def without(channels, *passes):
    return {name: c for name, c in channels.items() if name.split(".")[1] not in passes}


def test_an_animation_is_a_sequence_with_references_and_samples_from_the_header(tmp_path):
    scene = blender.describe(layout_samples.blender(tmp_path))[0]
    assert (scene.name, scene.indices, scene.sequence, scene.depth) == ("shot", (1, 2, 3), True, "z")
    frame = scene.read(2)
    assert (frame.spp, frame.notes["reference_spp"]) == (16, 4096)
    assert np.array_equal(frame.buffers["reference"], picture(2)["reference"])


def test_colour_is_the_noisy_image_and_not_the_denoised_one(tmp_path):
    images = picture(1)
    frame = one(tmp_path, blender_channels(images))
    assert np.array_equal(frame.buffers["color"], images["color"])
    frame = one(tmp_path, without(blender_channels(images), "Noisy Image"))
    assert np.allclose(frame.buffers["color"], images["color"] * np.float32(0.9))
    assert frame.notes["assumed"]["color"] == "Combined, there is no Noisy Image"


def test_features_keep_their_values(tmp_path):
    images = picture(1)
    frame = one(tmp_path, blender_channels(images))
    for name in ("normal", "position", "depth"):
        assert np.array_equal(frame.buffers[name], images[name]), name
    missed = (images["depth"] == 0)[..., 0]
    assert (frame.buffers["albedo"][missed] == 1).all()
    assert np.allclose(frame.buffers["albedo"][~missed], np.minimum(images["albedo"] + 0.04, 1)[~missed])
    assert np.allclose(frame.buffers["diffuse_albedo"], images["albedo"] * np.float32(0.8))
    assert np.allclose(frame.buffers["specular_albedo"][~missed], 0.04)


def test_motion_is_turned_to_rows_that_count_from_the_top(tmp_path):
    frame = one(tmp_path, blender_channels(picture(1)))
    assert (frame.buffers["motion"] == np.float32([1.5, 0.25])).all()


def test_pixels_without_motion_have_none(tmp_path):
    channels = blender_channels(picture(1))
    channels["ViewLayer.Vector.X"][0, 0] = 10000
    channels["ViewLayer.Vector.Y"][0, 1] = np.nan
    assert (one(tmp_path, channels).buffers["motion"][0, :2] == 0).all()


def test_diffuse_has_emission_and_background_and_the_rest_is_specular(tmp_path):
    images = picture(1)
    frame = derive(one(tmp_path, blender_channels(images)), ["specular"])
    missed = (images["depth"] == 0)[..., 0]
    assert np.allclose(frame.buffers["diffuse"][missed], images["color"][missed])
    expected = np.float32(0.375) * np.float32(0.8) * images["albedo"]
    assert np.allclose(frame.buffers["diffuse"][~missed], expected[~missed], atol=1e-6)
    assert (frame.buffers["specular"][missed] == 0).all()


def test_subsurface_light_of_older_versions_is_diffuse(tmp_path):
    images = picture(1)
    channels = blender_channels(images)
    for name, value in (("SubsurfaceDir", 0.5), ("SubsurfaceInd", 0.25), ("SubsurfaceCol", 0.5)):
        channels |= lettered(f"ViewLayer.{name}", np.full_like(images["color"], value), RGB)
    plain = one(tmp_path, blender_channels(images)).buffers["diffuse"]
    assert np.allclose(one(tmp_path, channels).buffers["diffuse"], plain + np.float32(0.375), atol=1e-6)


@pytest.mark.parametrize("stored", [65504.0, np.inf])
def test_the_background_in_half_precision_is_no_hit(tmp_path, stored):
    images = picture(1)
    channels = half({n: np.minimum(c, 65504) for n, c in blender_channels(images).items()})
    channels["ViewLayer.Depth.Z"][images["depth"][..., 0] == 0] = stored
    frame = derive(one(tmp_path, channels), ["hit"])
    assert np.array_equal(frame.buffers["hit"], (images["depth"] > 0).astype(np.float32))
    assert "repaired" not in frame.notes


def test_substitutes_for_normal_and_depth_are_told(tmp_path):
    channels = without(blender_channels(picture(1)), "Normal", "Depth")
    frame = one(tmp_path, channels)
    assert blender.describe(tmp_path)[0].depth == "euclidean"
    assert "camera space" in frame.notes["assumed"]["normal"]
    assert np.array_equal(frame.buffers["depth"], picture(1)["depth"])
    assert "length of the path" in frame.notes["assumed"]["depth"]


def test_albedo_above_one_is_clipped_and_counted(tmp_path):
    channels = blender_channels(picture(1))
    channels["ViewLayer.Denoising Albedo.R"][5, 5] = 3
    frame = one(tmp_path, channels)
    assert frame.notes["clipped"]["albedo"] == 1
    assert frame.buffers["albedo"].max() == 1


def test_every_view_layer_with_a_picture_is_a_scene_and_names_may_have_dots(tmp_path):
    images = [picture(1), picture(2)]
    channels = blender_channels(images[0], "Set v1.2") | blender_channels(images[1], "Actors")
    channels |= lettered("Mask.IndexOB", np.ones((10, 14, 1), np.float32), "X")
    write_exr(tmp_path / "s" / "0001.exr", channels, {"cycles.Set v1.2.samples": "64"})
    scenes = blender.describe(tmp_path)
    assert [s.name for s in scenes] == ["s-Actors", "s-Set_v1.2"]
    assert np.array_equal(scenes[1].read(1).buffers["color"], images[0]["color"])
    assert (scenes[0].read(1).spp, scenes[1].read(1).spp) == (None, 64)


def test_newer_names_of_passes_are_known(tmp_path):
    renamed = {"DiffDir": "Diffuse Direct", "DiffInd": "Diffuse Indirect", "DiffCol": "Diffuse Color"}
    renamed |= {"Emit": "Emission", "Env": "Environment", "GlossCol": "Glossy Color"}
    channels = blender_channels(picture(1))
    new = {}
    for name, plane in channels.items():
        layer, name_of_pass, letter = name.split(".")
        new[f"{layer}.{renamed.get(name_of_pass, name_of_pass)}.{letter}"] = plane
    expected = one(tmp_path, channels).buffers
    found = one(tmp_path, new).buffers
    assert found.keys() == expected.keys()
    assert np.array_equal(found["diffuse"], expected["diffuse"])


@pytest.mark.parametrize(
    ("names", "reference_spp"),
    [
        (("shot_0001.exr", "shot_0001_ref.exr"), None),
        (("shot_0001.exr", "gt_shot_0001.exr"), None),
        (("noisy/0001.exr", "target/0001.exr"), None),
        (("0001.exr", "reference/0001.exr"), None),
        (("shot_0001_16spp.exr", "shot_0001_1024spp.exr"), 1024),
        (("16spp/0001.exr", "1024spp/0001.exr"), 1024),
        (("0001.exr", "ref_512spp_0001.exr"), 512),
    ],
)
def test_references_are_found_by_name(tmp_path, names, reference_spp):
    for name, color in zip(names, ("color", "reference"), strict=True):
        write_exr(tmp_path / "s" / name, blender_channels(picture(1), color=color))
    frame = next(blender.frames(tmp_path))
    assert np.array_equal(frame.buffers["reference"], picture(1)["reference"])
    assert frame.notes.get("reference_spp") == reference_spp
    assert frame.index == 1


def test_a_reference_may_be_a_plain_picture(tmp_path):
    blender_file(tmp_path / "s" / "0001.exr", 1, 16)
    write_exr(tmp_path / "s" / "ref" / "0001.exr", lettered("", picture(1)["reference"], RGB))
    assert np.array_equal(next(blender.frames(tmp_path)).buffers["reference"], picture(1)["reference"])


def test_several_numbers_of_samples_are_frames_of_one_view(tmp_path):
    for number in (1, 2):
        for spp in (4, 16, 256):
            blender_file(tmp_path / "s" / f"{number:04d}_{spp}spp.exr", number, spp)
    scene = blender.describe(tmp_path)[0]
    assert (scene.indices, scene.sequence) == ((0, 1, 2, 3), False)
    frames = [scene.read(i) for i in scene.indices]
    assert [(f.notes["view"], f.spp) for f in frames] == [(0, 4), (0, 16), (1, 4), (1, 16)]


def test_numbers_with_a_gap_are_no_sequence(tmp_path):
    for number in (1, 2, 4):
        blender_file(tmp_path / "s" / f"{number:04d}.exr", number, 16)
    scene = blender.describe(tmp_path)[0]
    assert (scene.indices, scene.sequence) == ((1, 2, 4), False)


def test_names_without_a_number_are_scenes_of_one_frame(tmp_path):
    for name in ("kitchen.exr", "garden_ref.exr", "garden.exr"):
        blender_file(tmp_path / name, 1, 16)
    assert [*scenes_of(tmp_path)] == ["garden", "kitchen"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("0001.exr", "0001_ref.exr", "gt/0001.exr"), "are references of the same frame; remove one"),
        (("0001.exr", "noisy/0001.exr"), "are the same frame with as many samples; remove one"),
        (("0001_ref.exr",), "is a reference, but its noisy image is missing"),
    ],
)
def test_names_that_contradict_each_other_are_listed(tmp_path, names, message):
    for name in names:
        blender_file(tmp_path / name, 1, 16)
    with pytest.raises(ValueError, match=message):
        blender.describe(tmp_path)


@pytest.mark.parametrize(
    ("passes", "message"),
    [
        (("Combined", "Noisy Image"), r"missing color \(pass Noisy Image or Combined\)"),
        (("Denoising Albedo", "DiffCol"), r"missing albedo \(pass Denoising Albedo or DiffCol of view layer"),
        (("Normal", "Denoising Normal"), r"missing normal \(pass Normal or Denoising Normal of view layer"),
    ],
)
def test_a_missing_pass_is_named_with_the_channels_found(tmp_path, passes, message):
    write_exr(tmp_path / "0001.exr", without(blender_channels(picture(1)), *passes))
    with pytest.raises(ValueError, match=rf"0001\.exr: {message}.*; found ViewLayer\."):
        blender.describe(tmp_path)


def test_a_reference_without_the_view_layer_is_named(tmp_path):
    blender_file(tmp_path / "0001.exr", 1, 16)
    write_exr(tmp_path / "0001_ref.exr", lettered("depth", picture(1)["depth"], "Z"))
    with pytest.raises(ValueError, match=r"0001_ref\.exr: missing reference .*; found depth\.Z"):
        next(blender.frames(tmp_path))


def test_later_frames_without_the_view_layer_and_truncated_files_are_named(tmp_path):
    blender_file(tmp_path / "0001.exr", 1, 16)
    blender_file(tmp_path / "0002.exr", 1, 16, layer="Other")
    scene = blender.describe(tmp_path)[0]
    with pytest.raises(ValueError, match=r"0002\.exr: view layer 'ViewLayer' has no picture"):
        scene.read(2)
    path = tmp_path / "0001.exr"
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ValueError, match=r"0001\.exr: .*(truncated|damaged)"):
        scene.read(1)


def test_references_of_another_size_are_named(tmp_path):
    blender_file(tmp_path / "0001.exr", 1, 16)
    write_exr(tmp_path / "0001_ref.exr", blender_channels(picture(1, (5, 6))))
    with pytest.raises(ValueError, match=r"0001_ref\.exr: 'reference' is 6x5"):
        next(blender.frames(tmp_path))


def test_a_folder_without_images_says_what_is_expected(tmp_path):
    (tmp_path / "scene.blend").write_bytes(b"")
    with pytest.raises(ValueError, match=r"no scene of the layout `blender` found, expected multi-layer"):
        blender.describe(tmp_path)


def test_the_miniature_is_recognised_pickled_and_ingested(tmp_path, monkeypatch):
    source = layout_samples.blender(tmp_path / "source")
    assert likeliest(source) == "blender"
    original = pickle.loads(pickle.dumps(blender.describe(source)[0])).read(3)
    output = tmp_path / "set"
    arguments = ["trainer", "ingest", source, "--layout", "blender", "--output", output, "--processes", 1]
    monkeypatch.setattr("sys.argv", [str(a) for a in arguments])
    assert main() == 0
    record = load_manifest(output).scenes["shot"]
    assert record.sequence
    assert [(f.index, f.spp, f.reference_spp) for f in record.frames] == [(i, 16, 4096) for i in (1, 2, 3)]
    stored = FrameSet(output).read("shot", 3)
    for name, array in original.buffers.items():
        assert np.allclose(stored.buffers[name], array, rtol=1e-3, atol=1e-3), name
