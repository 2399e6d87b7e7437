import numpy as np
import pytest

from data.derive import derive
from data.exr import read_exr, write_exr
from data.layouts import acfm
from tests.data.layout_miniatures import acfm as miniature
from tests.data.layout_miniatures import acfm_test, afgsa_folders, shot, write_one


def first_crop(root, role, spp="00032"):
    return root / "bathroom2" / f"bathroom2-0000-x128-{spp}spp_{role}.exr"


def test_scenes_are_the_folders_and_crops_are_views_and_no_sequence(tmp_path):
    scenes = acfm.describe(miniature(tmp_path))
    assert [(s.name, s.indices, s.sequence, s.depth) for s in scenes] == [
        ("bathroom2", (0, 1), False, "euclidean"),
        ("house", (0, 1), False, "euclidean"),
    ]
    assert "32 spp, reference 32768 spp" in scenes[0].provenance


def test_every_buffer_of_a_crop_is_read_and_the_texture_is_the_raw_albedo(tmp_path):
    frame = next(acfm.frames(miniature(tmp_path)))
    made = shot(0)
    for name, stored in (("diffuse", "diffuse"), ("diffuse_albedo", "albedo"), ("depth", "depth")):
        assert np.array_equal(frame.buffers[name], made[stored]), name
    assert np.array_equal(frame.buffers["reference"], made["converged_color"])
    assert np.array_equal(frame.buffers["reference_diffuse"], made["converged_diffuse"])
    assert (frame.spp, frame.notes["reference_spp"], frame.notes["view"]) == (32, 32768, 0)
    assert "albedo" not in frame.buffers
    assert (derive(frame, ["albedo"]).buffers["albedo"][0, 0] == 1).all()


def test_what_is_left_of_the_reference_is_listed(tmp_path):
    ignored = next(acfm.frames(miniature(tmp_path))).notes["ignored"]
    assert [name.rpartition("_")[2] for name in ignored] == ["specular.exr", "texture.exr"]


def test_broken_normals_and_negative_radiance_are_mended_and_counted(tmp_path):
    frame = next(acfm.frames(miniature(tmp_path)))
    assert frame.notes["repaired"] == {"normal": 1}
    assert (frame.buffers["normal"][9, 9] == 0).all()
    assert frame.notes["clipped"] == {"specular": 1}
    assert frame.buffers["specular"].min() == 0
    assert frame.buffers["normal"].min() < 0


@pytest.mark.parametrize("role", ["normal", "depth", "texture"])
def test_a_file_that_the_authors_loader_would_replace_by_zeros_is_named(tmp_path, role):
    first_crop(miniature(tmp_path), role).unlink()
    buffer = {"texture": "diffuse_albedo"}.get(role, role)
    message = rf"missing buffer '{buffer}' \({role}\.exr of bathroom2-0000-x128\); found .*_color\.exr"
    with pytest.raises(ValueError, match=message):
        acfm.describe(tmp_path)


def test_two_of_color_diffuse_and_specular_give_the_third(tmp_path):
    for role in ("color", "specular", "diffuse"):
        root = miniature(tmp_path / role, ("bathroom2",), 1)
        first_crop(root, role).unlink()
        frame = next(acfm.frames(root))
        # The specular part had one pixel below 0, which both parts of the sum have lost.
        good = shot(0)["specular"].min(-1) >= 0
        assert np.allclose(frame.buffers[role][good], shot(0)[role][good], atol=1e-5)
        assert role in frame.notes["derived"]


def test_one_of_color_diffuse_and_specular_is_not_enough(tmp_path):
    root = miniature(tmp_path)
    for role in ("color", "specular"):
        first_crop(root, role).unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'color' \(color\.exr.*or diffuse and specular\)"):
        acfm.describe(root)


def test_a_reference_without_color_is_the_sum_of_its_parts(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    first_crop(root, "color", "32768").unlink()
    frame = next(acfm.frames(root))
    assert np.allclose(frame.buffers["reference"], shot(0)["converged_color"], rtol=1e-6)
    assert frame.notes["derived"]["reference"] == "diffuse + specular"
    first_crop(root, "diffuse", "32768").unlink()
    write_one(first_crop(root, "color", "32768"), shot(0)["converged_color"])
    frame = next(acfm.frames(root))
    assert np.allclose(frame.buffers["reference_diffuse"], shot(0)["converged_diffuse"], atol=1e-6)
    assert frame.notes["derived"]["reference_diffuse"] == "color - specular, at least 0"
    first_crop(root, "color", "32768").unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'reference' \(color\.exr .* at 32768 spp"):
        acfm.describe(root)


def test_a_crop_without_its_reference_is_named_where_others_have_one(tmp_path):
    root = miniature(tmp_path)
    for role in ("color", "diffuse", "specular", "texture"):
        first_crop(root, role, "32768").unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'reference' \(color\.exr of bathroom2-0000-x128"):
        acfm.describe(root)


def test_crops_without_any_reference_are_read_without_one(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    for path in root.glob("*/*32768spp*"):
        path.unlink()
    frame = next(acfm.frames(root))
    assert "reference" not in frame.buffers
    assert "reference_spp" not in frame.notes


def test_test_scenes_have_an_albedo_and_one_frame_per_number_of_samples(tmp_path):
    scenes = acfm.describe(acfm_test(tmp_path))
    assert [s.name for s in scenes] == ["car", "living-room-2"]
    frames = [scenes[0].read(i) for i in scenes[0].indices]
    assert [(f.spp, f.notes["view"]) for f in frames] == [(4, 0), (32, 0)]
    assert np.array_equal(frames[0].buffers["diffuse_albedo"], shot(20)["albedo"])
    assert np.array_equal(frames[0].buffers["reference"], shot(20)["converged_color"])
    assert frames[0].notes["derived"]["color"] == "diffuse + specular"


def test_encoded_normals_are_decoded_and_it_is_said(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    normal = shot(0)["normal"]
    write_one(first_crop(root, "normal"), normal * np.float32(0.5) + np.float32(0.5))
    frame = next(acfm.frames(root))
    good = np.isfinite(normal).all(-1)
    assert np.allclose(frame.buffers["normal"][good], normal[good], atol=1e-6)
    assert frame.notes["decoded"] == {"normal": "2 n - 1, was stored in [0, 1]"}


def test_raw_normals_are_left_alone_even_where_none_is_negative(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    normal = np.abs(np.nan_to_num(shot(0)["normal"]))
    write_one(first_crop(root, "normal"), normal)
    frame = next(acfm.frames(root))
    assert np.array_equal(frame.buffers["normal"], normal)
    assert "decoded" not in frame.notes


def test_files_of_another_size_are_named(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    write_one(first_crop(root, "depth"), np.ones((5, 6, 1), np.float32))
    with pytest.raises(ValueError, match=r"_depth\.exr: 'depth' is 6x5, but 'color' of bathroom2/frame 0"):
        next(acfm.frames(root))
    miniature(tmp_path, ("bathroom2",), 1)
    for role in ("color", "diffuse"):
        write_one(first_crop(root, role, "32768"), np.ones((5, 6, 3), np.float32))
    with pytest.raises(ValueError, match=r"reference is 6x5, the noisy buffers are 24x20"):
        next(acfm.frames(root))


def test_a_truncated_file_is_named(tmp_path):
    path = first_crop(miniature(tmp_path), "diffuse")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"_diffuse\.exr: .*truncated"):
        list(acfm.frames(tmp_path))


def test_a_file_with_several_buffers_is_no_sibling(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    channels = read_exr(first_crop(root, "normal")).channels
    write_exr(first_crop(root, "normal"), {f"{g}.{c}": channels[c] for g in ("a", "b") for c in channels})
    with pytest.raises(ValueError, match=r"_normal\.exr: expected one buffer .*found a\.B"):
        next(acfm.frames(root))


def test_a_color_in_one_channel_is_refused(tmp_path):
    root = miniature(tmp_path, ("bathroom2",), 1)
    write_one(first_crop(root, "color"), np.ones((20, 24, 1), np.float32), "Y")
    with pytest.raises(ValueError, match=r"_color\.exr: buffer 'color' needs 3 channels, found Y"):
        next(acfm.frames(root))


def test_folders_without_such_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        acfm.describe(tmp_path / "none")
    with pytest.raises(ValueError, match="is empty"):
        acfm.describe(tmp_path)
    afgsa_folders(tmp_path)
    with pytest.raises(
        ValueError, match="no scene of the layout `acfm` found, expected <scene>/<crop>-00032"
    ):
        acfm.describe(tmp_path)
    assert acfm.likeness(tmp_path) == 0
