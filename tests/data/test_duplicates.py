from dataclasses import replace

import numpy as np
import pytest

from data.duplicates import GRID, box_mean, fingerprint, near_duplicates
from data.frame import Frame
from tests.data.miniature import Crop, sample_crop

WHOLE = Crop(0, 0, 320, 180)


def only_noisy(frame, seed=None):
    """Return the frame without its reference; a seed replaces its noise by other noise."""
    buffers = {n: frame.buffers[n] for n in ("color", "normal")}
    if seed is not None:
        generator = np.random.default_rng(seed)
        scale = generator.exponential(size=buffers["color"].shape[:2])[..., None]
        buffers["color"] = (frame.buffers["reference"] * scale).astype(np.float32)
    return replace(frame, buffers=buffers)


def pairs(frames, scenes):
    return near_duplicates([fingerprint(f) for f in frames], scenes)


def test_a_view_is_found_again_under_other_noise_exposure_and_name():
    frame = sample_crop("living-room-2", 0, WHOLE)
    again = only_noisy(frame, seed=1)
    again.buffers["color"] *= 7
    found = pairs([frame, again], ["train-room", "test-room"])
    assert [(p.first, p.second, p.same_view) for p in found] == [(0, 1, True)]
    assert found[0].normal == pytest.approx(1, abs=1e-4)


def test_a_frame_of_one_sample_per_pixel_is_found_by_its_converged_picture():
    for scene in ("classroom", "cbox-glossy", "living-room-2"):
        frame = sample_crop(scene, 0, WHOLE)
        assert pairs([frame, only_noisy(frame)], ["a", "b"])[0].same_view


def test_a_view_is_found_again_at_another_resolution():
    frame = sample_crop("cbox-glossy", 0, WHOLE)
    half = {n: b.reshape(90, 2, 160, 2, -1).mean((1, 3)) for n, b in frame.buffers.items()}
    assert pairs([frame, replace(frame, buffers=half)], ["a", "b"])[0].same_view


def test_different_scenes_are_no_duplicates():
    scenes = ["classroom", "cbox-glossy", "living-room-2"]
    assert pairs([sample_crop(s, 0, WHOLE) for s in scenes], scenes) == []


def test_frames_of_one_scene_are_no_duplicates():
    frames = [sample_crop("cbox-glossy", i, WHOLE) for i in range(3)]
    assert pairs(frames, ["cbox-glossy"] * 3) == []
    assert len(pairs(frames, ["a", "a", "b"])) == 2


def test_the_same_geometry_in_another_light_is_told_from_the_same_view():
    frame = sample_crop("living-room-2", 0, WHOLE)
    ramp = np.geomspace(0.01, 100, 320, dtype=np.float32)[:, None]
    other = frame.with_buffers(reference=frame.buffers["reference"] * ramp)
    found = pairs([frame, other], ["a", "b"])
    assert [p.same_view for p in found] == [False]


def test_flat_walls_in_different_light_are_nothing_in_common():
    normal = np.zeros((32, 48, 3), np.float32)
    normal[..., 2] = 1
    ramp = np.geomspace(0.01, 100, 48, dtype=np.float32)[None, :, None] * np.ones((32, 1, 3), np.float32)
    frames = [Frame({"color": c, "normal": normal}, "x", 0) for c in (ramp, ramp[:, ::-1])]
    assert pairs(frames, ["a", "b"]) == []


def test_frames_without_normals_are_compared_by_light_alone():
    frame = sample_crop("living-room-2", 0, WHOLE)
    bare = replace(frame, buffers={"reference": frame.buffers["reference"]})
    found = pairs([bare, bare], ["a", "b"])
    assert found[0].same_view
    assert np.isnan(found[0].normal)


def test_frames_without_radiance_or_damaged_ones_are_left_out():
    frame = sample_crop("cbox-glossy", 0, WHOLE)
    assert fingerprint(replace(frame, buffers={"depth": frame.buffers["depth"]})) is None
    prints = [None, fingerprint(frame), None, fingerprint(frame)]
    assert [(p.first, p.second) for p in near_duplicates(prints, list("abcd"))] == [(1, 3)]


def test_black_frames_have_a_fingerprint():
    black = Frame({"color": np.zeros((8, 8, 3), np.float32)}, "x", 0)
    assert np.isfinite(fingerprint(black).light).all()


@pytest.mark.parametrize("size", [(16, 24), (32, 48), (7, 5), (180, 320), (1, 1)])
def test_cells_keep_the_mean_of_any_image(size):
    image = np.random.default_rng(0).random((*size, 2), np.float32)
    cells = box_mean(image)
    assert cells.shape == (GRID[1], GRID[0], 2)
    np.testing.assert_allclose(cells.mean((0, 1)), image.mean((0, 1)), rtol=1e-5)


def test_cells_of_whole_pixels_are_plain_means():
    image = np.random.default_rng(0).random((32, 48, 3), np.float32)
    np.testing.assert_allclose(box_mean(image), image.reshape(16, 2, 24, 2, 3).mean((1, 3)), rtol=1e-5)
