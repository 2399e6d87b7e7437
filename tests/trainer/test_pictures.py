"""Pictures: the tone curve of the metrics, comparisons at equal exposure, colours that keep their order."""

from __future__ import annotations

import numpy as np
import torch

from trainer.metrics.functional import gamma
from trainer.reports.pictures import (
    ERROR_SCALE,
    colors,
    comparison,
    display,
    error_map,
    false_color,
    tone_map,
)

RNG = np.random.default_rng(3)


def image(height: int = 20, width: int = 30) -> np.ndarray:
    return RNG.gamma(0.5, 1.0, (height, width, 3)).astype(np.float32)


def test_display_values_are_those_that_the_metrics_judge() -> None:
    radiance = image()
    expected = gamma(torch.from_numpy(radiance) * 0.7).numpy()
    assert np.allclose(display(radiance, 0.7), expected, atol=1e-6)


def test_not_finite_and_negative_radiance_becomes_black_or_white() -> None:
    row = np.array([[[np.nan] * 3, [-1.0] * 3, [np.inf] * 3, [70000.0] * 3]], np.float32)
    assert np.asarray(tone_map(row))[0, :, 0].tolist() == [0, 0, 255, 255]


def test_colours_of_error_maps_get_lighter_throughout() -> None:
    linear = (colors() / 255.0) ** 2.2
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    assert colors().shape == (256, 3)
    assert (np.diff(luminance) >= -1e-4).all()
    assert luminance[0] < 0.001
    assert luminance[-1] > 0.8


def test_equal_images_have_a_black_error_map_and_large_errors_the_last_colour() -> None:
    radiance = np.full((4, 5, 3), 0.5, np.float32)
    assert np.asarray(error_map(radiance, radiance, 1.0)).max() == colors()[0].max()
    white = np.ones_like(radiance)
    assert (np.asarray(error_map(np.zeros_like(white), white, 1.0)) == colors()[255]).all()
    assert ERROR_SCALE < 1


def test_false_colour_clips_to_its_ends() -> None:
    picture = np.asarray(false_color(np.array([[-1.0, 0.0, 1.0, 9.0]], np.float32)))
    assert (picture[0, 0] == picture[0, 1]).all()
    assert (picture[0, 2] == picture[0, 3]).all()


def test_a_comparison_shows_what_is_there() -> None:
    reference = image(128, 128)
    full = comparison(image(128, 128), image(128, 128), image(128, 128), reference, 1.0)
    short = comparison(image(128, 128), None, image(128, 128), reference, 1.0)
    bare = comparison(image(128, 128), None, image(128, 128), None, 1.0)
    assert full.width > short.width > bare.width
    assert bare.height < short.height


def test_the_denoised_panel_is_the_tone_mapped_image_at_the_given_exposure() -> None:
    radiance = image(128, 300)
    picture = np.asarray(comparison(None, None, radiance, None, 0.3))
    panel = np.asarray(tone_map(radiance, 0.3))
    rows = [y for y in range(picture.shape[0] - 128) if (picture[y : y + 128, 10:310] == panel).all()]
    assert len(rows) == 1


def test_wide_frames_are_reduced_and_tiny_ones_do_not_fail() -> None:
    assert comparison(image(72, 1280), None, image(72, 1280), None, 1.0).width < 1400
    assert comparison(None, None, image(5, 6), image(5, 6), 1.0).width >= 512
