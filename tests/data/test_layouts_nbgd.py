import numpy as np
import pytest
from PIL import Image as Picture

from data.derive import derive
from data.layouts import nbgd
from tests.data.layout_miniatures import nbgd as miniature
from tests.data.miniature import bmfr_scene, sample_crop


def test_accumulated_light_in_half_precision_is_irradiance_and_said_to_be_accumulated(tmp_path):
    scene = nbgd.describe(miniature(tmp_path))[1]
    frame, source = scene.read(1), sample_crop("classroom", 1).buffers
    assert (scene.name, scene.indices, scene.sequence, scene.depth) == ("classroom", (0, 1), True, "z")
    assert frame.accumulated
    assert frame.notes["precision"]["irradiance"] == "half"
    assert np.array_equal(frame.buffers["irradiance"], source["irradiance"].astype(np.float16))
    for name in ("albedo", "normal", "reference"):
        assert np.array_equal(frame.buffers[name], source[name]), name
    assert (frame.exposure, frame.spp) == (1.0, None)


def test_the_depth_picture_is_in_0_to_1_and_said_to_be_normalised(tmp_path):
    frame = nbgd.describe(miniature(tmp_path))[1].read(0)
    depth = sample_crop("classroom", 0).buffers["depth"]
    scaled = (depth - depth.min()) / (depth.max() - depth.min())
    assert np.abs(frame.buffers["depth"] - scaled).max() <= 0.5 / 255 + 1e-6
    assert frame.notes["normalised"] == ["depth"]


def test_folders_of_64_samples_have_light_of_one_frame(tmp_path):
    frame = nbgd.describe(miniature(tmp_path, "64spp"))[1].read(0)
    assert (frame.spp, frame.accumulated) == (64, False)
    assert np.array_equal(frame.buffers["irradiance"], sample_crop("classroom", 0).buffers["irradiance"])


def test_with_positions_and_cameras_depth_follows_from_them(tmp_path):
    root = miniature(tmp_path, "positions")
    for path in root.glob("*/depth_normalized/*.png"):
        path.unlink()
    frame = nbgd.describe(root)[1].read(0)
    assert "depth" not in frame.buffers
    assert "normalised" not in frame.notes
    derived = derive(frame, ["depth"], depth_kind="z").buffers["depth"]
    source = sample_crop("classroom", 0)
    del source.buffers["depth"]
    assert np.allclose(derived, derive(source, ["depth"], depth_kind="z").buffers["depth"], rtol=1e-4)


def test_a_deep_picture_keeps_its_bits(tmp_path):
    root = miniature(tmp_path)
    grey = np.linspace(0, 65535, 32 * 48).reshape(32, 48).astype(np.uint16)
    Picture.fromarray(grey).save(root / "classroom" / "depth_normalized" / "0.png")
    frame = nbgd.describe(root)[1].read(0)
    assert np.allclose(frame.buffers["depth"][..., 0], grey / 65535, atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "lost", "named"),
    [
        ("accumulated", "depth_normalized/1.png", r"'depth' \(depth_normalized/1\.png, or inputs/world_pos"),
        ("accumulated", "inputs/shading_normal0.exr", r"'normal' \(inputs/shading_normal0\.exr\)"),
        (
            "accumulated",
            "radiance_accum/accum_color_noabd1.exr",
            r"'irradiance' \(radiance_accum/accum_color",
        ),
        ("64spp", "inputs/color0.exr", r"'irradiance' \(inputs/color0\.exr, or radiance_accum"),
        ("64spp", "inputs/reference1.exr", r"'reference' \(inputs/reference1\.exr\)"),
    ],
)
def test_a_missing_file_is_named_with_what_is_there(tmp_path, kind, lost, named):
    (miniature(tmp_path, kind) / "classroom" / lost).unlink()
    with pytest.raises(ValueError, match=rf"classroom: missing buffer {named}.*; found .*inputs/albedo"):
        nbgd.describe(tmp_path)


def test_a_gap_in_the_numbering_is_named(tmp_path):
    root = miniature(tmp_path, frames=3)
    for path in (root / "classroom").rglob("*1.*"):
        path.unlink()
    with pytest.raises(ValueError, match="classroom: frame 1 is missing between 0 and 2"):
        nbgd.describe(root)


def test_a_header_with_too_few_cameras_is_named(tmp_path):
    root = miniature(tmp_path, "positions", ("classroom",))
    header = root / "classroom" / "inputs" / "camera_matrices.h"
    miniature(tmp_path / "other", "positions", ("classroom",), frames=1)
    header.write_text((tmp_path / "other" / "classroom" / "inputs" / "camera_matrices.h").read_text())
    with pytest.raises(ValueError, match=r"camera_matrices\.h: .*has 1 matrices, none for frame 1"):
        nbgd.describe(root)[0].read(1)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"not a picture", "damaged PNG"), (None, "is 9000x9000, but the frame is 48x32")],
)
def test_a_broken_or_huge_picture_is_refused_before_it_is_decoded(tmp_path, content, message):
    path = miniature(tmp_path) / "classroom" / "depth_normalized" / "0.png"
    if content is None:
        Picture.new("1", (9000, 9000)).save(path)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"0\.png.*{message}"):
        nbgd.describe(tmp_path)[1].read(0)


def test_a_truncated_picture_is_named(tmp_path):
    path = miniature(tmp_path) / "classroom" / "depth_normalized" / "0.png"
    path.write_bytes(path.read_bytes()[:-150])
    with pytest.raises(ValueError, match=r"0\.png: damaged PNG file"):
        nbgd.describe(tmp_path)[1].read(0)


def test_the_data_of_bmfr_itself_is_not_taken_for_it(tmp_path):
    bmfr_scene(tmp_path, "classroom")
    assert nbgd.likeness(tmp_path) == 0
    with pytest.raises(ValueError, match=r"missing buffer|no scene"):
        nbgd.describe(tmp_path / "classroom" / "inputs")
