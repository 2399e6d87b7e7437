"""Importance maps against scipy's filter, darts and pruning against the procedure written out literally."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from data.importance import (
    FAILURES,
    PUBLISHED_SHARE,
    SHRINK,
    box_mean,
    candidate_stream,
    importance_candidates,
    importance_map,
    importance_positions,
    prune,
    throw_darts,
)
from data.patches import Position, generator_of


def scene(height: int = 90, width: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """Radiance that is noisy on the right, black at the top left, with a firefly; a bump in the normals."""
    generator = np.random.default_rng(3)
    y, x = np.mgrid[0:height, 0:width]
    color = 1 + (x > 80)[..., None] * generator.normal(0, 0.3, (height, width, 3))
    color[:20, :20] = 0
    color[60, 90] = 3e4
    normal = np.zeros((height, width, 3))
    normal[..., 2] = 1
    bump = (y - 45) ** 2 + (x - 30) ** 2 < 100
    normal[bump] = [0.6, 0, 0.8]
    return color.astype(np.float32), normal.astype(np.float32)


@pytest.mark.parametrize("side", [1, 2, 3, 8, 21, 32])
def test_box_means_are_those_of_a_mirrored_frame(side: int):
    plane = np.random.default_rng(1).exponential(1, (40, 57))
    assert np.allclose(box_mean(plane, side), ndimage.uniform_filter(plane, side), rtol=1e-12)


def test_a_firefly_changes_no_mean_outside_of_its_windows():
    plane = np.random.default_rng(1).exponential(1, (64, 80))
    clean = box_mean(plane, 16)
    plane[30, 40] = 1e15
    changed = box_mean(plane, 16) != clean
    rows, columns = np.nonzero(changed)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (23, 38, 33, 48)


def literal_map(color: np.ndarray, normal: np.ndarray, patch: int, floor: float) -> np.ndarray:
    total = np.zeros(color.shape[:2])
    for image, relative in ((color, True), (normal, False)):
        image = image.astype(np.float64)
        mean = ndimage.uniform_filter(image, (patch, patch, 1))
        squares = ndimage.uniform_filter(image**2, (patch, patch, 1))
        variance = np.maximum(squares - mean**2, 0)
        if relative:
            variance /= np.maximum(mean**2, floor)
        worth = np.minimum(variance.max(-1) ** (1 / 2.2), 1)
        total += worth / max(worth.max(), 1e-4)
    return total / total.max()


@pytest.mark.parametrize("floor", [1e-4, 1e-2])
def test_the_map_is_that_of_the_published_procedure(floor: float):
    color, normal = scene()
    found = importance_map(color, normal, 16, floor)
    assert found.dtype == np.float32
    assert found.max() == 1
    # scipy sums by differences, so the firefly leaves rounding errors behind: compare without it
    color[60, 90] = 1
    expected = literal_map(color, normal, 16, floor)
    assert np.allclose(importance_map(color, normal, 16, floor), expected, atol=1e-5)


def test_noise_and_edges_of_normals_are_worth_more_than_even_surfaces():
    color, normal = scene()
    found = importance_map(color, normal, 16)
    assert found[45, 21] > 0.3 > 0.05 > found[75, 60] >= 0  # the edge of the bump; an even surface
    assert found[30, 120] > 0.2


def test_without_normals_colour_alone_counts():
    color, normal = scene()
    flat = np.zeros_like(normal)
    alone = importance_map(color, None, 16)
    assert np.array_equal(alone, importance_map(color, flat, 16))
    assert not np.array_equal(alone, importance_map(color, normal, 16))


def test_a_higher_floor_gives_dark_noise_less_weight():
    generator = np.random.default_rng(1)
    color = generator.exponential(1, (64, 128, 3)).astype(np.float32)
    color[:, 64:] *= 0.005
    assert importance_map(color, None, 16, 1e-2)[32, 100] < importance_map(color, None, 16)[32, 100] / 2


def test_a_constant_frame_is_worth_nothing_and_gives_no_patch():
    grey = np.full((64, 80, 3), 0.5, np.float32)
    importance = importance_map(grey, None, 16)
    assert not importance.any()
    assert importance_positions(importance, 20, 16, (1,)) == []


def literal_darts(count: int, size: tuple[int, int], patch: int, seed: tuple[int, ...]) -> np.ndarray:
    """One candidate after the other, each against all that were accepted."""
    stream = candidate_stream(size, patch, generator_of(seed))
    radius = math.sqrt(size[0] * size[1] / count / math.pi)
    accepted = np.empty((0, 2), np.int64)
    while len(accepted) < count:
        for _ in range(FAILURES):
            x, y = next(stream)
            nearest = min(((accepted - (x, y)) ** 2).sum(1), default=10**9)
            if nearest > (2 * radius) ** 2:
                accepted = np.append(accepted, [[x, y]], axis=0)
                break
        else:
            radius *= SHRINK
    return accepted


@pytest.mark.parametrize(
    ("count", "size", "patch"), [(1, (40, 30), 16), (12, (200, 120), 32), (40, (160, 120), 16)]
)
def test_darts_fall_where_testing_one_after_the_other_puts_them(count, size, patch):
    for seed in range(3):
        found = throw_darts(count, size, patch, generator_of((seed,)))
        assert np.array_equal(found, literal_darts(count, size, patch, (seed,)))


def test_darts_keep_their_distance_and_reach_all_of_the_frame():
    found = throw_darts(400, (1280, 720), 128, generator_of((1,)))
    assert found.shape == (400, 2)
    assert (found >= 0).all()
    assert (found.max(0) < (1280 - 128, 720 - 128)).all()
    squared = ((found[:, None] - found[None]) ** 2).sum(-1)
    assert squared[~np.eye(400, dtype=bool)].min() > 30**2
    assert (found.min(0) < 20).all()
    assert (found.max(0) > (1280 - 128 - 20, 720 - 128 - 20)).all()


@pytest.mark.parametrize("size", [(16, 16), (18, 16), (17, 19)])
def test_frames_with_fewer_places_than_candidates_repeat_some(size: tuple[int, int]):
    found = throw_darts(30, size, 16, generator_of((1,)))
    assert found.shape == (30, 2)
    assert (found >= 0).all()
    assert (found <= np.maximum(np.subtract(size, 17), 0)).all()
    places = {(x, y) for x in range(max(size[0] - 16, 1)) for y in range(max(size[1] - 16, 1))}
    assert {tuple(place) for place in found.tolist()} == places


def literal_pruning(
    centres: np.ndarray, worths: np.ndarray, size: tuple[int, int], side: int, seed: tuple[int, ...]
) -> np.ndarray:
    generator = generator_of(seed)
    kept, error = np.zeros(len(centres), bool), 0.0
    for row in range(0, size[1], side):
        columns = list(range(0, size[0], side))
        if row // side % 2:
            columns.reverse()
        for column in columns:
            for i, (x, y) in enumerate(centres):
                if column <= x < column + side and row <= y < row + side:
                    kept[i] = worths[i] - error > generator.random()
                    error += 1 - worths[i] if kept[i] else -worths[i]
    return kept


def test_pruning_is_that_of_the_regions_in_snake_order():
    generator = np.random.default_rng(2)
    centres = generator.integers(0, (300, 200), (120, 2))
    worths = generator.random(120)
    for seed in range(5):
        found = prune(centres, worths, (300, 200), 64, generator_of((seed,)))
        assert np.array_equal(found, literal_pruning(centres, worths, (300, 200), 64, (seed,)))


def test_the_number_that_is_kept_is_the_sum_of_the_importances_within_one():
    generator = np.random.default_rng(2)
    counts = []
    centres, worths = generator.integers(0, (300, 200), (120, 2)), generator.random(120)
    for seed in range(400):
        kept = prune(centres, worths, (300, 200), 64, generator_of((seed,)))
        counts.append(int(kept.sum()))
        assert abs(counts[-1] - worths.sum()) < 1
    assert abs(np.mean(counts) - worths.sum()) < 0.1


def test_candidates_of_importance_one_are_all_kept_and_of_zero_none():
    ones = np.ones((60, 80), np.float32)
    assert len(importance_positions(ones, 25, 16, (1,))) == 25
    assert importance_positions(0 * ones, 25, 16, (1,)) == []


def test_chosen_patches_lie_where_the_importance_is():
    color, normal = scene(120, 200)
    importance = importance_map(color, normal, 16)
    found = [p for seed in range(20) for p in importance_positions(importance, 40, 16, (seed,))]
    mean = np.mean([importance[p.y + 8, p.x + 8] for p in found])
    assert mean > 1.3 * importance[8:-8, 8:-8].mean()


def test_candidates_name_the_pruned_ones_and_positions_leave_them_out():
    importance = importance_map(*scene(), 16)
    candidates = importance_candidates(importance, 30, 16, (7, "a"))
    assert len(candidates) == 30
    assert None in candidates
    kept = importance_positions(importance, 30, 16, (7, "a"))
    assert kept == [p for p in candidates if p is not None]
    assert 0 < len(kept) < 30


def test_positions_repeat_for_a_seed_and_differ_for_others():
    importance = importance_map(*scene(), 16)
    drawn = [tuple(importance_positions(importance, 20, 16, seed)) for seed in ((1, "a"), (1, "b"), (2, "a"))]
    assert len(set(drawn)) == 3
    assert drawn[0] == tuple(importance_positions(importance, 20, 16, (1, "a")))


def test_positions_are_the_same_on_every_machine():
    ones = np.ones((180, 320), np.float32)
    assert importance_positions(ones, 3, 128, (1, "train", "a", 0)) == EXPECTED


EXPECTED = [Position(40, 14), Position(191, 45), Position(123, 0)]


def test_frames_smaller_than_a_patch_are_refused():
    color, normal = scene(90, 100)
    with pytest.raises(ValueError, match="100x90, smaller than a patch of 128x128"):
        importance_map(color, normal, 128)
    with pytest.raises(ValueError, match=r"cave/frame 3 is 100x90, smaller"):
        importance_positions(color[..., 0], 4, 128, (1,), "cave/frame 3")
    with pytest.raises(ValueError, match="expected a positive number"):
        importance_map(color, normal, 16, floor=0)


def test_the_published_share_is_that_of_258_of_400():
    assert round(400 * PUBLISHED_SHARE) == 258
