import shutil

import numpy as np
import pytest

from data.derive import derive
from data.exr import write_exr
from data.layouts import bmfr, likeliest
from data.layouts.bmfr_camera import read_cameras
from tests.data.miniature import BMFR_FILES, Crop, bmfr_scene, camera_header, sample_crop, write_rgb

MATRICES = [np.arange(16.0).reshape(4, 4) - 7.25, np.eye(4) * 1e-3]


def header(tmp_path, text):
    path = tmp_path / "camera_matrices.h"
    path.write_text(text)
    return path


def test_a_camera_header_holds_matrices_offsets_and_limits(tmp_path):
    text = camera_header(MATRICES, (0.0016, 0.25), [(0.25, 0.75), (0.5, 0.5)])
    cameras = read_cameras(header(tmp_path, text))
    assert np.allclose(cameras.matrices, MATRICES)
    assert cameras.pixel_offsets.tolist() == [[0.25, 0.75], [0.5, 0.5]]
    assert (cameras.position_limit_squared, cameras.normal_limit_squared) == (0.0016, 0.25)


def test_a_camera_header_may_hold_matrices_only(tmp_path):
    cameras = read_cameras(header(tmp_path, camera_header(MATRICES, None)))
    assert len(cameras.matrices) == 2
    assert cameras.pixel_offsets is None
    assert cameras.position_limit_squared is None


def test_bare_rows_without_a_declaration_are_understood(tmp_path):
    rows = "\n".join(f"// frame {i}\n{m.tolist()}" for i, m in enumerate(MATRICES))
    assert np.allclose(read_cameras(header(tmp_path, rows)).matrices, MATRICES)


def test_comments_suffixes_exponents_and_tabs_do_not_matter(tmp_path):
    text = """/* written 12.5.2019, 60 frames */
        const float position_limit_squared=9e-4f;
        const float camera_matrices [1] [4] [4] =
        {\t{ { 1.0f, -2, .5, 3. },{1e1,1E-1,+4,0},\t{0,0,0,0}, // 99.9
        {0.f, 0.f, 1, 1} } };
        """
    cameras = read_cameras(header(tmp_path, text))
    assert cameras.matrices[0].tolist() == [[1, -2, 0.5, 3], [10, 0.1, 4, 0], [0] * 4, [0, 0, 1, 1]]
    assert cameras.position_limit_squared == pytest.approx(0.0009)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found 0 numbers"),
        ("const float camera_matrices[1][4][4] = { {1, 2, 3} };", "found 3 numbers"),
        ("const float position_limit_squared = 0.1;", "found 0 numbers"),
        (
            camera_header(MATRICES, None, [(0.5, 0.5)]).replace("[1][2]", "[2][2]"),
            "2 matrices, but 2 numbers",
        ),
        (camera_header(MATRICES, (0.0, 1.0)), "position_limit_squared is not one positive number"),
    ],
)
def test_a_damaged_camera_header_is_refused(tmp_path, text, message):
    if "pixel_offsets" in text:
        text = text.replace("pixel_offsets[2]", "pixel_offsets[1]")
    with pytest.raises(ValueError, match=rf"camera_matrices\.h: .*{message}"):
        read_cameras(header(tmp_path, text))


def test_the_camera_projects_as_a_row_vector_times_the_matrix(tmp_path):
    frame = sample_crop("classroom", 0)
    bmfr_scene(tmp_path, "classroom")
    scene = bmfr.describe(tmp_path)[0]
    camera = scene.read(0).camera
    assert np.allclose(camera.world_to_pixel[[0, 1, 3]], frame.camera.world_to_pixel[[0, 1, 3]], atol=1e-3)
    assert camera.centre() == pytest.approx(frame.camera.centre(), abs=1e-4)


def test_offsets_are_turned_to_count_from_the_top(tmp_path):
    cameras = read_cameras(header(tmp_path, camera_header(MATRICES, None, [(0.25, 0.375), (0.5, 0.5)])))
    assert cameras.camera(0, 8, 8).offset == (0.25, 0.625)
    with pytest.raises(ValueError, match="2 matrices, none for frame 2"):
        cameras.camera(2, 8, 8)


def test_frames_have_the_buffers_of_the_data_set_with_color_as_irradiance(tmp_path):
    bmfr_scene(tmp_path, "classroom")
    frames = list(bmfr.frames(tmp_path))
    assert [f.index for f in frames] == [0, 1]
    assert set(frames[0].buffers) == set(BMFR_FILES.values())
    assert np.array_equal(frames[1].buffers["irradiance"], sample_crop("classroom", 1).buffers["irradiance"])
    assert (frames[0].exposure, frames[0].spp, frames[0].scene) == (1.0, 1, "classroom")


def test_depth_is_the_w_of_the_projected_position(tmp_path):
    bmfr_scene(tmp_path, "living-room-2", name="living-room")
    scene = bmfr.describe(tmp_path)[0]
    frame = derive(scene.read(1), ["depth"], depth_kind=scene.depth)
    original = sample_crop("living-room-2", 1)
    matrix = original.camera.world_to_pixel
    expected = original.buffers["position"] @ matrix[3, :3] + matrix[3, 3]
    assert np.allclose(frame.buffers["depth"][..., 0], expected, atol=1e-5)


def test_limits_come_from_the_header_and_otherwise_from_the_table(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom", name="livingroom")
    assert bmfr.describe(tmp_path)[0].thresholds["position_limit_squared"] == 0.01
    (folder / "inputs" / "camera_matrices.h").write_text(camera_header([np.eye(4)] * 2, None))
    assert bmfr.describe(tmp_path)[0].thresholds == {
        "position_limit_squared": 0.0009,
        "normal_limit_squared": 0.04,
    }


@pytest.mark.parametrize("place", ["classroom/camera_matrices.h", "classroom.h", "cameras/classroom.h"])
def test_camera_headers_are_found_where_both_projects_keep_them(tmp_path, place):
    folder = bmfr_scene(tmp_path, "classroom")
    (tmp_path / place).parent.mkdir(exist_ok=True)
    shutil.move(folder / "inputs" / "camera_matrices.h", tmp_path / place)
    assert bmfr.describe(tmp_path)[0].indices == (0, 1)


def test_a_scene_or_its_inputs_can_be_the_root(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    for root in (folder, folder / "inputs"):
        assert [(s.name, s.indices) for s in bmfr.describe(root)] == [("classroom", (0, 1))]


def test_accumulated_colors_beside_the_inputs_are_ignored(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    write_rgb(folder / "acc_colors" / "color0.exr", np.zeros((4, 4, 3)))
    assert len(list(bmfr.frames(tmp_path))) == 2


def test_a_set_without_references_is_read_without_them(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    for path in (folder / "inputs").glob("reference*.exr"):
        path.unlink()
    assert "reference" not in next(bmfr.frames(tmp_path)).buffers


@pytest.mark.parametrize("role", list(BMFR_FILES))
def test_a_missing_file_is_named(tmp_path, role):
    folder = bmfr_scene(tmp_path, "classroom")
    (folder / "inputs" / f"{role}1.exr").unlink()
    with pytest.raises(ValueError, match=rf"inputs: missing {role}1\.exr; every frame needs color, albedo"):
        bmfr.describe(tmp_path)


def test_a_gap_in_the_numbering_is_named(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom", 3)
    for path in (folder / "inputs").glob("*1.exr"):
        path.unlink()
    with pytest.raises(ValueError, match="inputs: frame 1 is missing between 0 and 2"):
        bmfr.describe(tmp_path)


def test_too_few_cameras_are_an_error(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    (folder / "inputs" / "camera_matrices.h").write_text(camera_header([np.eye(4)]))
    with pytest.raises(ValueError, match=r"1 matrices, but .* has frames up to 1"):
        bmfr.describe(tmp_path)


def test_a_missing_camera_header_lists_where_it_was_looked_for(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    (folder / "inputs" / "camera_matrices.h").unlink()
    with pytest.raises(FileNotFoundError, match=r"no camera header; looked for .*cameras/classroom\.h"):
        bmfr.describe(tmp_path)


def test_files_of_different_size_are_named_with_their_sizes(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    small = sample_crop("classroom", 0, Crop(width=20, height=10)).buffers["normal"]
    write_rgb(folder / "inputs" / "shading_normal0.exr", small)
    with pytest.raises(ValueError, match=r"shading_normal0\.exr is 20x10, but color0\.exr is 48x32"):
        next(bmfr.frames(tmp_path))


def test_a_truncated_file_is_named(tmp_path):
    path = bmfr_scene(tmp_path, "classroom") / "inputs" / "albedo0.exr"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"albedo0\.exr: .*truncated"):
        next(bmfr.frames(tmp_path))


def test_other_channels_than_rgb_are_refused(tmp_path):
    path = bmfr_scene(tmp_path, "classroom") / "inputs" / "albedo0.exr"
    write_exr(path, {"Y": np.zeros((32, 48), np.float32)})
    with pytest.raises(ValueError, match=r"albedo0\.exr"):
        next(bmfr.frames(tmp_path))


def test_broken_pixels_are_counted_per_buffer(tmp_path):
    folder = bmfr_scene(tmp_path, "classroom")
    color = sample_crop("classroom", 0).buffers["irradiance"].copy()
    color[3, 4] = np.nan
    write_rgb(folder / "inputs" / "color0.exr", color)
    frame = next(bmfr.frames(tmp_path))
    assert frame.notes["repaired"] == {"irradiance": 1}
    assert all(np.isfinite(b).all() for b in frame.buffers.values())


def test_likeness_and_errors_for_folders_of_another_kind(tmp_path):
    bmfr_scene(tmp_path / "b", "classroom")
    assert likeliest(tmp_path / "b") == "bmfr"
    (tmp_path / "x").mkdir()
    assert likeliest(tmp_path / "x") is None
    with pytest.raises(ValueError, match="is empty"):
        bmfr.describe(tmp_path / "x")
    (tmp_path / "x" / "y").mkdir()
    with pytest.raises(ValueError, match="no scene of the layout `bmfr` found, expected <scene>/inputs/"):
        bmfr.describe(tmp_path / "x")
    with pytest.raises(FileNotFoundError):
        bmfr.describe(tmp_path / "none")
