"""Samples that do not count: marked as a whole, left out of means, counted."""

from __future__ import annotations

import numpy as np
import pytest

from data.buffers import sample_channels
from data.dropped import Dropped, count, mark, mean, mean_of_hits, mean_variance, require_marked, total

CHANNELS = sample_channels("radiance", "depth")


def broken() -> np.ndarray:
    """Five samples of 6x7 pixels, of which a tenth have a NaN or infinity somewhere, all of pixel (0, 0)."""
    rng = np.random.default_rng(5)
    values = rng.exponential(1.0, (5, 6, 7, 4)).astype(np.float32)
    values[rng.random(values.shape) < 0.02] = np.nan
    values[rng.random(values.shape) < 0.02] = np.inf
    values[:, 0, 0, 1] = -np.inf
    return values


def plain(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the mean of each pixel, from the list of its samples that count."""
    shape = values.shape[1:]
    means, variances = np.full(shape, np.nan), np.full(shape, np.nan)
    for y, x in np.ndindex(*shape[:2]):
        good = [s for s in values[:, y, x].astype(np.float64) if np.isfinite(s).all()]
        if good:
            means[y, x] = sum(good) / len(good)
            spread = sum((s - means[y, x]) ** 2 for s in good)
            variances[y, x] = spread / (len(good) - 1) / len(good) if len(good) > 1 else 0
    return means, variances


def test_a_sample_with_one_broken_value_is_marked_in_all_channels_and_no_other() -> None:
    values, before = broken(), broken()
    far = np.isinf(before[..., 3])
    gone = np.isnan(before).any(-1) | np.isinf(before[..., :3]).any(-1)
    dropped, replaced = mark(values, CHANNELS)
    assert replaced == far.sum() > 0
    assert np.isnan(values[gone]).all()
    expected = np.where(np.isinf(before), 0, before)
    assert np.array_equal(values[~gone], expected[~gone])
    assert dropped == (gone.sum(), gone.any(0).sum(), gone.all(0).sum())
    assert count(values) == dropped


def test_whole_samples_are_left_alone() -> None:
    values = np.ones((2, 3, 4, 4), np.float32)
    assert mark(values, CHANNELS) == (None, 0)
    assert count(values) is None
    require_marked(values, CHANNELS)


def test_means_and_variances_are_those_of_the_samples_that_count() -> None:
    values = broken()
    mark(values, CHANNELS)
    means, variances = plain(values)
    np.testing.assert_allclose(mean(values), means, rtol=1e-5)
    np.testing.assert_allclose(mean_variance(values), variances, rtol=1e-4, atol=1e-7)


def test_means_of_samples_that_all_count_are_plain_means() -> None:
    values = np.random.default_rng(1).random((4, 3, 2, 3), np.float32)
    assert np.array_equal(mean(values), values.mean(0, dtype=np.float32))
    np.testing.assert_allclose(mean_variance(values), values.var(0, ddof=1) / 4, rtol=1e-5)
    assert not mean_variance(values[:1]).any()


def test_depths_are_means_over_hits_that_count() -> None:
    depth = np.array([2, 0, np.nan, 4, np.nan, np.nan], np.float32).reshape(3, 1, 2, 1)
    assert mean_of_hits(depth).ravel().tolist() == [2, 4]
    assert mean_of_hits(np.full((2, 1, 1, 1), np.nan, np.float32)) == 0


def test_half_marked_samples_are_refused_by_channel() -> None:
    values = np.ones((2, 3, 4, 4), np.float32)
    values[1, 2, 3, 2] = np.nan
    with pytest.raises(ValueError, match=r"channel radiance\.R holds NaN or Inf|channel radiance\.B holds"):
        require_marked(values, CHANNELS)


def test_counts_are_told_in_one_sentence_and_added_up() -> None:
    assert Dropped(1, 1, 0).text() == "1 sample with NaN or Inf in 1 pixel was dropped"
    assert Dropped(9, 2, 1).text().endswith("; 1 pixel had no other and was filled from around it")
    assert total([[1, 1, 0], [9, 2, 1]]) == (10, 3, 1)
    assert total([]) is None
