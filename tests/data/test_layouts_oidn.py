import pickle
import shutil

import numpy as np
import pytest

from data.derive import derive
from data.exr import write_exr
from data.frames import FrameSet
from data.layouts import likeliest, oidn
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_samples import RGB, half, lettered, oidn_view, picture
from trainer.cli import main


def as_half(image):
    return image.astype(np.float16).astype(np.float32)


def test_the_tree_of_the_documentation_has_a_frame_per_view_and_number_of_samples(tmp_path):
    scenes = oidn.describe(layout_samples.oidn(tmp_path))
    assert [(s.name, s.indices, s.sequence) for s in scenes] == [
        ("scene1", (0, 1, 2), False),
        ("scene2", (0, 1), False),
    ]
    frames = [scenes[0].read(i) for i in scenes[0].indices]
    assert [(f.notes["view"], f.spp, f.notes["reference_spp"]) for f in frames] == [
        (0, 1, 8192),
        (0, 4, 8192),
        (1, 1, 8192),
    ]
    assert [scenes[1].read(i).spp for i in (0, 1)] == [8, 64]
    assert "reference_spp" not in scenes[1].read(0).notes


def test_radiance_reference_and_features_keep_their_values(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"), seed=7)
    images, frame = picture(7), next(oidn.frames(tmp_path))
    for name, key in (("color", "color"), ("reference", "reference"), ("normal", "normal")):
        assert np.array_equal(frame.buffers[name], as_half(images[key])), name
    assert np.array_equal(frame.buffers["diffuse_albedo"], as_half(images["albedo"]))


def test_samples_are_sorted_as_numbers(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "16spp", "128spp"))
    scene = oidn.describe(tmp_path)[0]
    assert [scene.read(i).spp for i in scene.indices] == [4, 16]
    assert scene.read(0).notes["reference_spp"] == 128


@pytest.mark.parametrize("word", ["ref", "reference", "gt", "target", "GT"])
def test_a_marked_reference_leaves_every_number_of_samples_an_input(tmp_path, word):
    oidn_view(tmp_path, "room", ("", "9999spp", word))
    scene = oidn.describe(tmp_path)[0]
    assert [scene.read(i).spp for i in scene.indices] == [None, 9999]
    assert np.array_equal(scene.read(1).buffers["reference"], as_half(picture(1)["reference"]))


def test_a_single_image_has_no_reference(tmp_path):
    oidn_view(tmp_path, "room", ("4spp",))
    assert "reference" not in next(oidn.frames(tmp_path)).buffers


def test_encoded_normals_are_decoded_and_misses_stay_zero(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"), seed=3, encoded=True)
    frame = next(oidn.frames(tmp_path))
    assert np.allclose(frame.buffers["normal"], picture(3)["normal"], atol=2e-3)
    assert "2 n - 1" in frame.notes["decoded"]["normal"]


def test_normals_that_are_never_negative_are_not_decoded_when_they_are_unit_vectors(tmp_path):
    oidn_view(tmp_path, "room", ("4spp",))
    floor = np.zeros((10, 14, 3), np.float32)
    floor[..., 1] = 1
    write_exr(tmp_path / "room_4spp.nrm.exr", lettered("", floor, RGB))
    assert np.array_equal(next(oidn.frames(tmp_path)).buffers["normal"], floor)


def test_an_albedo_without_zeros_is_the_effective_one_and_is_clipped(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    albedo = np.full((10, 14, 3), 0.5, np.float32)
    albedo[0], albedo[1, 0] = 1, 1.75
    write_exr(tmp_path / "room_4spp.alb.exr", half(lettered("", albedo, RGB)))
    frame = next(oidn.frames(tmp_path))
    assert "diffuse_albedo" not in frame.buffers
    assert np.array_equal(frame.buffers["albedo"], np.minimum(albedo, 1))
    assert frame.notes["clipped"]["albedo"] == 1
    assert "effective" in frame.notes["assumed"]["albedo"]
    assert frame.notes["precision"]["albedo"] == "half"


def test_an_albedo_that_is_zero_where_nothing_shines_is_still_effective(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    color = picture(1)["color"]
    color[:2, :3] = 0
    write_exr(tmp_path / "room_4spp.hdr.exr", half(lettered("", color, RGB)))
    frame = next(oidn.frames(tmp_path))
    assert (frame.buffers["albedo"][:2, :3] == 1).all()
    assert np.isfinite(derive(frame, ["irradiance"]).buffers["irradiance"]).all()


def test_features_of_another_version_serve_where_a_version_has_none(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    (tmp_path / "room_4spp.nrm.exr").unlink()
    shutil.move(tmp_path / "room_4spp.alb.exr", tmp_path / "room.alb.exr")
    frame = next(oidn.frames(tmp_path))
    assert "room_ref.nrm.exr holds for 4 spp too" in frame.notes["assumed"]["normal"]
    assert frame.notes["assumed"]["diffuse_albedo"] == "room.alb.exr holds for 4 spp too"


def test_radiance_alone_is_enough_and_other_features_are_ignored(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    for path in [*tmp_path.glob("*.alb.exr"), *tmp_path.glob("*.nrm.exr")]:
        path.rename(str(path).replace(".alb.", ".sh1x.").replace(".nrm.", ".ldr."))
    assert set(next(oidn.frames(tmp_path)).buffers) == {"color", "reference"}


def test_negative_and_broken_radiance_is_counted(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    color = picture(1)["color"]
    color[3, 3], color[4, 4] = -0.5, np.nan
    write_exr(tmp_path / "room_4spp.hdr.exr", lettered("", color, RGB))
    frame = next(oidn.frames(tmp_path))
    assert (frame.notes["clipped"]["color"], frame.notes["repaired"]["color"]) == (1, 1)
    assert frame.buffers["color"].min() >= 0


def test_exposure_comes_from_the_json_beside_an_image(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    (tmp_path / "room.json").write_text('{"exposure": 2.5}')
    assert next(oidn.frames(tmp_path)).exposure == 2.5
    (tmp_path / "room.json").write_text('{"exposure": -1}')
    with pytest.raises(ValueError, match=r"room\.json: exposure -1\.0, expected a positive number"):
        next(oidn.frames(tmp_path))


@pytest.mark.parametrize(
    ("versions", "message"),
    [
        (("0004", "4spp"), r"room_4spp\.(alb|hdr|nrm)\.exr and room_0004\..* are the same image"),
        (("ref", "gt"), "are the same image; remove one"),
        (("ref",), r"there is a reference, but no noisy image such as room_4spp\.hdr\.exr"),
    ],
)
def test_images_that_contradict_each_other_are_named(tmp_path, versions, message):
    oidn_view(tmp_path, "room", versions)
    with pytest.raises(ValueError, match=message):
        oidn.describe(tmp_path)


def test_missing_radiance_is_named(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    (tmp_path / "room_4spp.hdr.exr").rename(tmp_path / "room_4spp.ldr.exr")
    with pytest.raises(ValueError, match=r"room_4spp\.\w+\.exr has no \.hdr\.exr"):
        oidn.describe(tmp_path)


def test_a_scene_of_a_folder_and_one_of_a_file_may_not_share_a_name(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    oidn_view(tmp_path / "room", "a", ("4spp", "ref"))
    with pytest.raises(ValueError, match="make a scene called 'room'"):
        oidn.describe(tmp_path)


def test_files_of_different_size_and_truncated_files_are_named(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    path = tmp_path / "room_4spp.alb.exr"
    write_exr(path, lettered("", np.zeros((4, 4, 3), np.float32), RGB))
    with pytest.raises(ValueError, match=r"room_4spp\.alb\.exr: 'diffuse_albedo' is 4x4, but 'color'"):
        next(oidn.frames(tmp_path))
    path.write_bytes((tmp_path / "room_ref.alb.exr").read_bytes()[:-60])
    with pytest.raises(ValueError, match=r"room_4spp\.alb\.exr: .*truncated"):
        next(oidn.frames(tmp_path))


def test_files_of_several_features_are_refused(tmp_path):
    oidn_view(tmp_path, "room", ("4spp", "ref"))
    planes = lettered("albedo", picture(1)["albedo"], RGB) | lettered("normal", picture(1)["normal"], RGB)
    write_exr(tmp_path / "room_4spp.alb.exr", planes)
    with pytest.raises(ValueError, match=r"room_4spp\.alb\.exr: expected the channels R, G, B"):
        next(oidn.frames(tmp_path))


def test_a_folder_without_images_says_what_is_expected(tmp_path):
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(
        ValueError, match=r"no image of the layout `oidn` found, expected <name>_<spp>spp\.hdr"
    ):
        oidn.describe(tmp_path)


def test_the_miniature_is_recognised_pickled_and_ingested(tmp_path, monkeypatch):
    source = layout_samples.oidn(tmp_path / "source")
    assert likeliest(source) == "oidn"
    scene = pickle.loads(pickle.dumps(oidn.describe(source)[0]))
    original = scene.read(1)
    output = tmp_path / "set"
    arguments = ["trainer", "ingest", source, "--layout", "oidn", "--output", output, "--processes", 1]
    monkeypatch.setattr("sys.argv", [str(a) for a in arguments])
    assert main() == 0
    records = load_manifest(output).scenes["scene1"].frames
    assert [(r.view, r.spp, r.reference_spp) for r in records] == [(0, 1, 8192), (0, 4, 8192), (1, 1, 8192)]
    stored = FrameSet(output).read("scene1", 1)
    assert np.array_equal(stored.buffers["reference"], original.buffers["reference"])
    assert {"albedo", "irradiance"} <= stored.buffers.keys()
