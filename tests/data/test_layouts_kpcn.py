import numpy as np
import pytest

from data.exr import read_exr, write_exr
from data.layouts import kpcn
from data.layouts.channels import channel_groups
from tests.data.layout_miniatures import acfm, shot, write_merged
from tests.data.layout_miniatures import kpcn as miniature


def noisy(root):
    return root / "car" / "1000-00128spp.exr"


def without(path, *groups):
    """Write a merged file again without some groups."""
    kept = {c: v for c, v in read_exr(path).channels.items() if c.partition(".")[0] not in groups}
    write_exr(path, kept)


def test_channels_are_grouped_by_what_is_before_the_first_dot_and_ordered():
    channels = ["B", "normal.Z", "G", "R", "normal.X", "normal.Y", "a.b.R", "A", "depth.Z", "a.c"]
    assert channel_groups(channels) == {
        "default": ["R", "G", "B", "A"],
        "normal": ["normal.X", "normal.Y", "normal.Z"],
        "a": ["a.b.R", "a.c"],
        "depth": ["depth.Z"],
    }


def test_every_group_is_read_from_its_channels_and_normals_are_rgb(tmp_path):
    scene = kpcn.describe(miniature(tmp_path))[0]
    frame, made = scene.read(0), shot(80)
    assert (scene.name, scene.indices, scene.sequence) == ("car", (0, 1), False)
    assert (frame.spp, frame.notes["reference_spp"], frame.notes["view"]) == (128, 8192, 0)
    assert {c for c in read_exr(noisy(tmp_path)).channels if c.startswith("normal.")} == {
        f"normal.{letter}" for letter in "RGB"
    }
    for name, stored in (("diffuse", "diffuse"), ("diffuse_albedo", "albedo"), ("depth", "depth")):
        assert np.array_equal(frame.buffers[name], made[stored]), name
    assert np.array_equal(frame.buffers["normal"], np.nan_to_num(made["normal"]))
    assert np.array_equal(frame.buffers["reference"], made["converged_color"])
    assert np.array_equal(frame.buffers["reference_diffuse"], made["converged_diffuse"])


def test_a_variance_in_one_channel_counts_for_every_channel_and_it_is_said(tmp_path):
    frame = kpcn.describe(miniature(tmp_path))[0].read(0)
    expected = shot(80)["diffuseVariance"].mean(-1, keepdims=True)
    assert np.allclose(frame.buffers["diffuse_variance"], np.repeat(expected, 3, -1), rtol=1e-6)
    assert frame.buffers["depth_variance"].shape == (20, 24, 1)
    assert frame.notes["derived"]["normal_variance"] == "normalVariance.Z for every channel"
    assert "depth_variance" not in frame.notes["derived"]


def test_a_variance_in_three_channels_is_read_per_channel(tmp_path):
    frame = kpcn.describe(miniature(tmp_path, "RGB"))[0].read(0)
    assert np.array_equal(frame.buffers["diffuse_variance"], shot(80)["diffuseVariance"])
    assert frame.notes["derived"] == {}


def test_groups_with_a_and_b_are_halves(tmp_path):
    frame = kpcn.describe(miniature(tmp_path, halves=True))[0].read(0)
    assert np.array_equal(frame.buffers["color_a"], shot(80)["colorA"])
    assert np.array_equal(frame.buffers["diffuse_albedo_b"], shot(80)["albedoB"])


@pytest.mark.parametrize(("group", "buffer"), [("albedo", "diffuse_albedo"), ("normal", "normal")])
def test_a_missing_group_is_named_with_the_channels_found(tmp_path, group, buffer):
    without(noisy(miniature(tmp_path)), group)
    message = rf"1000-00128spp\.exr: missing buffer '{buffer}' \(channels {group}\.\*\); found B, .*depth\.Z"
    with pytest.raises(ValueError, match=message):
        kpcn.describe(tmp_path)


@pytest.mark.parametrize("group", ["diffuse", "specular", "default"])
def test_two_of_color_diffuse_and_specular_are_enough(tmp_path, group):
    path = noisy(miniature(tmp_path))
    channels = {
        c: v
        for c, v in read_exr(path).channels.items()
        if (c.partition(".")[0] if "." in c else "default") != group
    }
    write_exr(path, channels)
    frame = kpcn.describe(tmp_path)[0].read(0)
    name = {"default": "color"}.get(group, group)
    assert name in frame.notes["derived"]
    good = shot(80)["specular"].min(-1) >= 0
    assert np.allclose(frame.buffers[name][good], shot(80)[name][good], atol=1e-4)


def test_the_group_color_counts_where_there_is_no_default(tmp_path):
    made = shot(3)
    groups = {g: made[g] for g in ("color", "diffuse", "specular", "albedo", "normal", "depth")}
    write_merged(tmp_path / "room.exr", groups)
    write_merged(tmp_path / "room_gt.exr", {"color": made["converged_color"]})
    scene = kpcn.describe(tmp_path)[0]
    assert (scene.name, scene.read(0).spp) == ("room", None)
    assert np.array_equal(scene.read(0).buffers["color"], np.maximum(made["color"], 0))
    assert np.array_equal(scene.read(0).buffers["reference"], made["converged_color"])


def test_several_numbers_of_samples_of_one_view_share_its_reference(tmp_path):
    root = miniature(tmp_path, scenes=("car",))
    noisy(root).rename(root / "car" / "1000-00032spp.exr")
    made = shot(80)
    groups = {g: made[g] for g in ("diffuse", "specular", "albedo", "normal", "depth")}
    write_merged(root / "car" / "1000-00004spp.exr", {"default": made["color"], **groups})
    scene = kpcn.describe(root)[0]
    told = [(f.spp, f.notes["view"], f.notes["reference_spp"]) for f in map(scene.read, scene.indices)]
    assert told == [(4, 0, 8192), (32, 0, 8192), (128, 1, 8192)]


def test_a_view_without_reference_is_named_where_others_have_one(tmp_path):
    (miniature(tmp_path) / "car" / "1001-08192spp.exr").unlink()
    with pytest.raises(ValueError, match=r"missing buffer 'reference' \(no reference beside 1001-00128spp"):
        kpcn.describe(tmp_path)


def test_a_reference_without_color_is_named(tmp_path):
    path = miniature(tmp_path) / "car" / "1000-08192spp.exr"
    write_exr(path, {c: v for c, v in read_exr(path).channels.items() if c.startswith("diffuse")})
    with pytest.raises(ValueError, match=r"08192spp\.exr: missing buffer 'reference' .*found diffuse\.B"):
        kpcn.describe(tmp_path)


def frame_groups(seed):
    made = shot(seed)
    return {"default": made["color"]} | {
        g: made[g] for g in ("diffuse", "specular", "albedo", "normal", "depth")
    }


def test_one_reference_without_a_name_is_that_of_the_only_view(tmp_path):
    write_merged(tmp_path / "a" / "sample.exr", frame_groups(3))
    write_merged(tmp_path / "a" / "gt.exr", {"default": shot(3)["converged_color"]})
    frame = kpcn.describe(tmp_path)[0].read(0)
    assert np.array_equal(frame.buffers["reference"], shot(3)["converged_color"])
    write_merged(tmp_path / "a" / "another.exr", frame_groups(4))
    with pytest.raises(ValueError, match=r"missing buffer 'color' \(the noisy file that gt\.exr is the ref"):
        kpcn.describe(tmp_path)


def test_a_reference_without_its_frame_is_named(tmp_path):
    write_merged(tmp_path / "hall.exr", frame_groups(3))
    for name in ("hall", "roof"):
        write_merged(tmp_path / f"{name}_ref.exr", {"default": shot(3)["converged_color"]})
    with pytest.raises(
        ValueError, match=r"the noisy file that roof_ref\.exr is the reference of\); found hall"
    ):
        kpcn.describe(tmp_path)


def test_channels_without_a_meaning_are_listed(tmp_path):
    path = noisy(miniature(tmp_path))
    extra = np.ones((20, 24), np.float32)
    write_exr(path, {**read_exr(path).channels, "crypto.R": extra, "normal.A": extra})
    assert kpcn.describe(tmp_path)[0].read(0).notes["ignored"] == ["crypto.R"]


def test_a_layout_that_looks_closer_is_named_with_the_buffer(tmp_path):
    acfm(tmp_path)
    with pytest.raises(
        ValueError, match=r"missing buffer .*; it looks like the layout `acfm`: use --layout acfm"
    ):
        kpcn.describe(tmp_path)


def test_damaged_files_are_named(tmp_path):
    path = noisy(miniature(tmp_path))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"1000-00128spp\.exr: .*truncated"):
        list(kpcn.frames(tmp_path))
    path.write_bytes(content[:60])
    with pytest.raises(ValueError, match=r"1000-00128spp\.exr: .*(truncated|damaged)"):
        kpcn.describe(tmp_path)
    path.write_bytes(b"no EXR at all")
    with pytest.raises(ValueError, match=r"1000-00128spp\.exr: not an OpenEXR file"):
        kpcn.describe(tmp_path)
    assert kpcn.likeness(tmp_path) < 1


def test_folders_without_exr_files_are_refused(tmp_path):
    (tmp_path / "x").mkdir()
    with pytest.raises(ValueError, match="no scene of the layout `kpcn` found, expected merged EXR files"):
        kpcn.describe(tmp_path)
