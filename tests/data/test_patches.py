from __future__ import annotations

import numpy as np
import pytest

from data.patches import Position, cut, legacy_positions, patch_count, uniform_positions


def test_a_frame_of_1280x720_gives_exactly_the_published_numbers():
    assert {patch_count(80, 1280, 720, i) for i in range(60)} == {80}
    assert {patch_count(20, 1280, 720, i) for i in range(60)} == {20}


def test_other_sizes_keep_the_density_on_average():
    counts = [patch_count(20, 320, 180, i) for i in range(8)]
    assert counts == [1, 1, 1, 2, 1, 1, 1, 2]
    assert sum(patch_count(80, 1920, 1080, i) for i in range(10)) == 1800


def test_a_small_frame_gives_at_least_one_patch_and_none_only_when_asked():
    assert patch_count(1, 128, 128, 0) == 1
    assert patch_count(0, 1280, 720, 0) == 0


def test_a_negative_number_of_patches_is_refused():
    with pytest.raises(ValueError, match="expected 0 or more"):
        patch_count(-1, 1280, 720, 0)


def test_positions_lie_inside_and_reach_both_edges():
    found = uniform_positions(3000, (40, 24), 16, (1, "train", "hall", 0))
    assert {p.x for p in found} == set(range(25))
    assert {p.y for p in found} == set(range(9))


def test_positions_differ_by_split_scene_frame_and_seed_and_repeat_otherwise():
    seeds = [(1, "train", "a", 0), (1, "validation", "a", 0), (1, "train", "b", 0), (1, "train", "a", 1)]
    seeds.append((2, "train", "a", 0))
    drawn = [tuple(uniform_positions(20, (320, 180), 128, seed)) for seed in seeds]
    assert len(set(drawn)) == len(seeds)
    assert drawn[0] == tuple(uniform_positions(20, (320, 180), 128, seeds[0]))


def test_positions_are_the_same_on_every_machine():
    assert uniform_positions(3, (320, 180), 128, (1, "train", "a", 0)) == EXPECTED


EXPECTED = [Position(40, 18), Position(52, 21), Position(137, 9)]


def test_a_frame_smaller_than_a_patch_names_frame_size_and_option():
    with pytest.raises(ValueError, match=r"cave/f001\.exr is 100x90, smaller.*128x128.*--patch-size 90"):
        uniform_positions(1, (100, 90), 128, (1,), "cave/f001.exr")


def test_legacy_positions_see_the_top_left_part_of_a_published_frame():
    found = legacy_positions(100_000, (1280, 720), 128, (1,))
    columns, rows = [p.x for p in found], [p.y for p in found]
    assert (min(columns), max(columns) + 127) == (-128, 1022)
    assert (min(rows), max(rows) + 127) == (-128, 462)


def test_legacy_crops_of_a_frame_of_two_patches_or_less_are_refused():
    with pytest.raises(ValueError, match="larger than two patches, 256x256"):
        legacy_positions(1, (320, 180), 128, (1,))


def test_cut_pads_with_zeros_outside_of_the_image():
    image = np.arange(1, 26, dtype=np.float32).reshape(5, 5, 1)
    corner = cut(image, Position(-2, -1), 4)
    assert np.array_equal(corner[1:, 2:, 0], image[:3, :2, 0])
    assert corner[0].sum() == corner[:, :2].sum() == 0
    assert np.array_equal(cut(image, Position(1, 1), 4), image[1:, 1:])
    assert not cut(image, Position(-9, 0), 4).any()
