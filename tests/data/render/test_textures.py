from __future__ import annotations

import numpy as np
import pytest

from data.render.textures import (
    BRIGHTEST,
    PATTERNS,
    muted,
    random_colour,
    random_palette,
    random_pattern,
    random_texture,
    random_weights,
)

TILING = ("smooth", "cells", "checker", "bricks", "tiles", "marble", "dots", "weave", "maze")


@pytest.mark.parametrize("kind", PATTERNS)
def test_texture_is_a_varied_picture_of_reflectances(kind: str) -> None:
    picture = random_texture(np.random.default_rng(1), kind)
    height, width, channels = picture.pixels.shape
    assert height == width
    assert height in (128, 256, 512)
    assert channels == 3
    assert picture.pixels.dtype == np.float32
    assert picture.pixels.min() >= 0.0199
    assert picture.pixels.max() <= BRIGHTEST + 1e-6
    assert picture.pixels.std((0, 1)).max() > 0.004
    assert not picture.raw


@pytest.mark.parametrize("kind", PATTERNS)
def test_same_generator_state_gives_the_same_texture(kind: str) -> None:
    first, second = (random_texture(np.random.default_rng(2), kind).pixels for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("kind", TILING)
def test_pattern_continues_over_its_edges(kind: str) -> None:
    value = random_pattern(np.random.default_rng(3), kind)
    assert np.abs(value[0] - value[-1]).max() <= np.abs(np.diff(value, axis=0)).max() * 1.5 + 1e-9
    assert np.abs(value[:, 0] - value[:, -1]).max() <= np.abs(np.diff(value, axis=1)).max() * 1.5 + 1e-9


def test_some_textures_are_of_high_frequency() -> None:
    def roughness(seed: int) -> float:
        pixels = random_texture(np.random.default_rng(seed)).pixels.mean(-1)
        return float(np.abs(np.diff(pixels, axis=1)).mean() / max(pixels.std(), 1e-6))

    values = [roughness(seed) for seed in range(20)]
    assert max(values) > 0.3
    assert min(values) < 0.1


def test_colours_are_reflectances_and_differ() -> None:
    rng = np.random.default_rng(0)
    colours = np.stack([random_colour(rng) for _ in range(300)])
    assert colours.min() >= 0.02
    assert colours.max() <= BRIGHTEST
    assert (colours.std(0) > 0.1).all()
    grey = np.ptp(colours, axis=1) < 1e-6
    assert 0.05 < grey.mean() < 0.3


def test_palettes_have_two_to_five_colours() -> None:
    rng = np.random.default_rng(0)
    assert {len(random_palette(rng)) for _ in range(200)} == {2, 3, 4, 5}


def test_muting_keeps_the_mean_and_removes_the_hue() -> None:
    colour = np.array([0.8, 0.2, 0.2])
    np.testing.assert_allclose(muted(colour, 0.0), 0.4)
    np.testing.assert_allclose(muted(colour, 1.0), colour)
    assert muted(colour, 0.5).mean() == pytest.approx(0.4)


def test_weights_run_over_their_range_and_are_no_colour() -> None:
    picture = random_weights(np.random.default_rng(0), 0.1, 0.4)
    assert picture.raw
    assert picture.pixels.shape[2] == 1
    assert picture.pixels.min() == pytest.approx(0.1)
    assert picture.pixels.max() == pytest.approx(0.4)
