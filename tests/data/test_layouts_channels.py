import numpy as np
import OpenEXR
import pytest

from data.exr import RadianceWarning, read_exr, write_exr
from data.layouts.channels import Gathering, is_encoded_normal, missing_buffer
from tests.data.layout_miniatures import acfm, shot

RNG = np.random.default_rng(0)


def normals(height=12, width=16):
    made = RNG.normal(size=(height, width, 3))
    return (made / np.linalg.norm(made, axis=-1, keepdims=True)).astype(np.float32)


def test_normals_of_every_direction_are_told_from_encoded_ones():
    assert not is_encoded_normal(normals())
    assert is_encoded_normal(normals() * np.float32(0.5) + np.float32(0.5))


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, -1), (0.6, 0, 0.8), (0.2, -0.6, 0.775)])
def test_a_single_wall_is_enough_to_tell_them_apart(direction):
    wall = np.ones((4, 4, 1), np.float32) * np.array(direction, np.float32)
    assert not is_encoded_normal(wall)
    assert is_encoded_normal((wall + 1) / 2)


def test_an_image_without_any_hit_is_not_called_encoded():
    for value in (0.0, 0.5):
        assert not is_encoded_normal(np.full((4, 4, 3), value, np.float32))


def test_pixels_without_a_hit_become_zero_when_normals_are_decoded():
    stored = (normals() + 1) / 2
    stored[0], stored[1] = 0, 0.5
    gathering = Gathering("s/frame 0")
    gathering.put("normal", stored, "x.exr")
    decoded = gathering.frame("s", 0, None).buffers["normal"]
    assert (decoded[:2] == 0).all()
    assert np.allclose(np.linalg.norm(decoded[2:], axis=-1), 1, atol=1e-5)


def test_halves_and_variance_of_encoded_normals_are_decoded_too():
    a, b = normals(), normals()
    gathering = Gathering("s/frame 0")
    gathering.put("normal", (normals() + 1) / 2, "x.exr")
    for name, half in (("normal_a", a), ("normal_b", b)):
        gathering.put(name, (half + 1) / 2, "x.exr")
    gathering.put("normal_variance", ((a - b) / 4) ** 2, "x.exr")
    buffers = gathering.frame("s", 0, None).buffers
    assert np.allclose(buffers["normal_b"], b, atol=1e-6)
    assert np.allclose(buffers["normal_variance"], ((a - b) / 2) ** 2, atol=1e-6)


def test_pixels_outside_the_data_window_are_no_hit_and_counted(tmp_path):
    window = {
        "dataWindow": (np.array([0, 0], np.int32), np.array([3, 3], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([7, 3], np.int32)),
    }
    pixels = {"Z": np.ones((4, 4), np.float32)}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **window}, pixels).write(str(tmp_path / "a.exr"))
    gathering = Gathering("s/frame 0")
    gathering.add("depth", read_exr(tmp_path / "a.exr"), ["Z"])
    assert (gathering.buffers["depth"][:, 4:] == 0).all()
    assert gathering.notes["outside_data_window"] == {"depth": 16}


def test_radiance_that_was_tone_mapped_is_reported(tmp_path):
    clipped = np.minimum(RNG.gamma(0.5, 2, (32, 32, 3)), 1).astype(np.float32)
    write_exr(tmp_path / "color.exr", {c: clipped[..., i].copy() for i, c in enumerate("RGB")})
    with pytest.warns(RadianceWarning, match=r"color\.exr: buffer 'color' is clipped at 1"):
        Gathering("s/frame 0").add("color", read_exr(tmp_path / "color.exr"), ["R", "G", "B"])


def test_a_buffer_that_comes_twice_is_refused():
    gathering = Gathering("s/frame 0")
    gathering.put("color", shot(0)["converged_color"], "a.exr")
    with pytest.raises(ValueError, match=r"b\.exr: a second 'color' for s/frame 0"):
        gathering.put("color", shot(0)["converged_color"], "b.exr")


def test_halves_keep_values_below_zero_since_their_mean_has_to_stay():
    made, gathering = shot(0), Gathering("s/frame 0")
    gathering.put("specular_a", made["specularA"], "a.exr")
    assert gathering.buffers["specular_a"].min() < 0
    assert "clipped" not in gathering.notes


def test_the_error_for_a_missing_buffer_lists_a_few_channels_and_closer_layouts(tmp_path):
    found = [f"x{i}.R" for i in range(30)]
    error = str(missing_buffer("kpcn", "a.exr", "buffer 'depth'", found, acfm(tmp_path)))
    assert error.startswith("a.exr: missing buffer 'depth'; found x0.R, x1.R, ")
    assert error.endswith("x15.R and 14 more; it looks like the layout `acfm`: use --layout acfm")
    assert "looks like" not in str(missing_buffer("acfm", "a.exr", "buffer 'depth'", found, tmp_path))
    assert str(missing_buffer("acfm", "a.exr", "buffer 'x'", [], tmp_path)).endswith("found nothing")
