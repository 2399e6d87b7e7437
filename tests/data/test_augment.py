from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from data.augment import LEFT, RIGHT, Augmentation, Turn, reordered, turn_vectors, turned
from data.buffers import buffer

IMAGE = np.arange(2 * 4 * 4, dtype=np.float32).reshape(2, 4, 4)


def test_turns_are_the_flips_and_quarter_turns_of_numpy():
    assert np.array_equal(turned(IMAGE, Turn.FLIP_X), np.flip(IMAGE, 2))
    assert np.array_equal(turned(IMAGE, Turn.FLIP_Y), np.flip(IMAGE, 1))
    assert np.array_equal(turned(IMAGE, LEFT), np.rot90(IMAGE, 1, (1, 2)))
    assert np.array_equal(turned(IMAGE, RIGHT), np.rot90(IMAGE, -1, (1, 2)))


def test_the_eight_turns_are_all_different():
    assert len({turned(IMAGE, Turn(bits)).tobytes() for bits in range(8)}) == 8


@pytest.mark.parametrize("bits", range(8))
def test_motion_points_at_the_same_pixel_after_a_turn(bits: int):
    # A vector field that points from each pixel to the pixel with number 6 (row 1, column 2).
    rows, columns = np.mgrid[0:4, 0:4].astype(np.float32)
    field = np.stack([2 - columns, 1 - rows])
    number = np.arange(16, dtype=np.float32).reshape(1, 4, 4)
    turn = Turn(bits)
    vectors, target = turned(field, turn).copy(), turned(number, turn)
    turn_vectors(vectors, turn)
    reached = np.round(np.stack([columns, rows]) + vectors).astype(int)
    assert (target[0][reached[1], reached[0]] == 6).all()


def test_quarter_turns_need_square_patches():
    with pytest.raises(ValueError, match="needs a square patch, got 6x4"):
        turned(np.zeros((1, 4, 6), np.float32), LEFT)


def test_wskp_rule_leaves_half_alone_and_turns_the_rest_in_four_ways_equally():
    drawn = Counter(Augmentation("wskp", seed=3).turn(epoch, s) for epoch in range(20) for s in range(1000))
    assert set(drawn) == {Turn.NONE, Turn.FLIP_X, Turn.FLIP_Y, LEFT, RIGHT}
    assert abs(drawn[Turn.NONE] / 20000 - 0.5) < 0.02
    assert all(abs(drawn[turn] / 20000 - 0.125) < 0.01 for turn in (Turn.FLIP_X, Turn.FLIP_Y, LEFT, RIGHT))


def test_dihedral_rule_draws_all_eight_equally():
    drawn = Counter(Augmentation("dihedral").turn(0, sample) for sample in range(16000))
    assert len(drawn) == 8
    assert all(abs(count / 16000 - 0.125) < 0.01 for count in drawn.values())


def test_augmentation_follows_from_seed_epoch_and_sample_alone():
    first = [Augmentation(seed=5, exposure_stops=2).turn(1, s) for s in range(64)]
    assert first == [Augmentation(seed=5).turn(1, s) for s in range(64)]
    assert first != [Augmentation(seed=6).turn(1, s) for s in range(64)]
    assert first != [Augmentation(seed=5).turn(2, s) for s in range(64)]


def test_exposure_varies_within_the_given_stops_evenly():
    factors = np.log2([Augmentation(exposure_stops=1.5).exposure_factor(0, s) for s in range(4000)])
    assert -1.5 <= factors.min() < -1.45
    assert 1.45 < factors.max() <= 1.5
    assert abs(factors.mean()) < 0.05
    assert Augmentation().exposure_factor(0, 0) == 1.0


def test_unknown_rules_and_negative_stops_are_refused():
    with pytest.raises(ValueError, match="expected wskp, dihedral or none"):
        Augmentation("mirror")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected 0 to 16"):
        Augmentation(exposure_stops=-1)


def test_permutation_is_the_same_for_radiance_and_reflectance_so_the_product_still_holds():
    augmentation = Augmentation("none", seed=3, permute=True)
    rng = np.random.default_rng(0)
    irradiance, albedo = rng.random((2, 3, 4, 4), dtype=np.float32)
    seen = set()
    for sample in range(60):
        change = augmentation.change(0, sample)
        parts = [
            reordered(image, name, change) for image, name in ((irradiance, "irradiance"), (albedo, "albedo"))
        ]
        product = reordered(irradiance * albedo, "reference", change)
        assert np.array_equal(parts[0] * parts[1], product)
        seen.add(change.colors)
    assert len(seen) == 6


def test_world_axes_change_by_all_symmetries_of_a_cube_and_keep_lengths_and_angles():
    augmentation = Augmentation("none", seed=1, permute=True)
    normals = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0].astype(np.float32)[:, :, None]
    seen = set()
    for sample in range(600):
        change = augmentation.change(2, sample)
        turned_normals = reordered(normals, "normal", change)[:, :, 0]
        assert np.allclose(turned_normals.T @ turned_normals, np.eye(3), atol=1e-6)
        seen.add((change.axes, change.signs))
    assert len(seen) == 48


def test_depth_motion_and_history_keep_their_channels():
    change = Augmentation("none", permute=True).change(0, 1)
    for name in ("depth", "motion", "history"):
        image = np.ones((buffer(name).channels, 2, 2), np.float32)
        assert reordered(image, name, change) is image


def test_history_is_dropped_with_the_given_probability_and_never_at_zero():
    dropped = [Augmentation(drop_history=0.25, seed=5).change(0, n).alone for n in range(2000)]
    assert 0.2 < np.mean(dropped) < 0.3
    assert not any(Augmentation(seed=5).change(0, n).alone for n in range(200))


@pytest.mark.parametrize("value", [-0.1, 1.5])
def test_impossible_probability_of_dropped_history_is_refused(value):
    with pytest.raises(ValueError, match="drop_history"):
        Augmentation(drop_history=value)


def test_variances_of_world_vectors_change_places_with_their_coordinates_and_stay_positive():
    augmentation = Augmentation("none", seed=4, permute=True)
    normal = np.array([0.1, -0.5, 0.8], np.float32).reshape(3, 1, 1)
    for sample in range(60):
        change = augmentation.change(0, sample)
        squares = reordered(normal, "normal", change) ** 2
        assert np.allclose(reordered(normal**2, "normal_variance", change), squares)


@pytest.mark.parametrize("name", ["color", "diffuse", "specular", "albedo"])
def test_variances_of_colours_are_permuted_with_what_they_belong_to(name: str):
    change = Augmentation("none", seed=4, permute=True).change(0, 5)
    image = np.arange(3, dtype=np.float32).reshape(3, 1, 1)
    assert change.colors != (0, 1, 2)
    expected = reordered(image, "reference", change)
    assert np.array_equal(reordered(image, name, change), expected)
    assert np.array_equal(reordered(image, f"{name}_variance", change), expected)
    assert np.array_equal(reordered(image, "reference_diffuse", change), expected)


@pytest.mark.parametrize("bits", range(8))
def test_variance_of_motion_is_that_of_the_turned_motion(bits: int):
    field = np.random.default_rng(2).normal(size=(2, 3, 3)).astype(np.float32)
    squares = field**2
    turn_vectors(field, Turn(bits))
    turn_vectors(squares, Turn(bits), "motion_variance")
    assert np.array_equal(squares, field**2)
