"""Histograms of samples: the formula, what follows from samples, what files keep."""

import numpy as np
import pytest

from data.augment import Change, reordered
from data.derive import automatic_exposure, derive, obtainable
from data.exr import read_frame, write_frame
from data.frame import Frame, Samples
from data.histograms import add_samples, places, sample_histogram
from tests.models import plain_rhf

RNG = np.random.default_rng(5)


def light(samples=9, height=5, width=4):
    values = RNG.gamma(0.5, 3, (samples, height, width, 3)).astype(np.float32)
    values[0, 0], values[1, 1], values[2, 2] = 0, -1, 1e5
    values[3, 3, 1, 2] = np.nan
    return values


@pytest.mark.parametrize("exposure", [1.0, 0.3])
def test_histograms_follow_the_literal_formula(exposure):
    values = light()
    expected = plain_rhf.histogram(values.astype(np.float64), exposure).reshape(5, 4, 60)
    assert np.allclose(sample_histogram(values, exposure), expected, atol=1e-5)


def test_every_sample_that_counts_adds_one_to_each_colour():
    sums = sample_histogram(light()).reshape(5, 4, 3, 20).sum(-1)
    expected = np.full((5, 4, 3), 9.0)
    expected[3, 1] = 8
    assert np.allclose(sums, expected, atol=1e-5)


def test_known_radiances_lie_in_known_bins():
    known = np.array([0, -3, 2.5**2.2, (2.5 * 1.25) ** 2.2, 5**2.2, 1e9, (2.5 / 18 * 3.5) ** 2.2], np.float32)
    low, upper = places(known, 1.0)
    assert low.max() == 18
    assert np.allclose(low + upper, [0, 0, 18, 18.25, 19, 19, 3.5], atol=1e-4)


def test_samples_may_come_in_any_parts():
    values, whole = light(), np.zeros((5, 4, 60), np.float32)
    for part in (values[:2], values[2:3], values[3:]):
        add_samples(whole, part)
    assert np.array_equal(whole, sample_histogram(values))


def frame(**changes):
    values = light()
    values[3, 3, 1] = np.nan
    color = np.ones((5, 4, 3), np.float32)
    return Frame({"color": color}, "room", 2, samples=Samples.of({"radiance": values}), **changes)


@pytest.mark.parametrize("exposure", [0.5, None])
def test_histograms_follow_from_samples_that_are_exposed(exposure):
    given = frame(exposure=exposure)
    found = derive(given, ["histogram"])
    radiance = given.samples.get("radiance")
    used = exposure or automatic_exposure(np.nan_to_num(np.nanmean(radiance, 0)))
    assert np.allclose(found.buffers["histogram"], sample_histogram(radiance, used), atol=1e-4)
    assert found.notes["derived"]["histogram"] == f"samples times exposure {used:.6g}"


def test_histograms_can_be_had_of_frames_with_samples_alone():
    given = frame()
    assert obtainable(given, ["histogram", "albedo"]) == {"histogram"}
    given.samples = None
    assert obtainable(given, ["histogram"]) == set()
    with pytest.raises(ValueError, match=r"missing buffer 'histogram'.*trainer render stills --histogram"):
        derive(given, ["histogram"])


def test_histograms_are_read_as_they_were_written(tmp_path):
    given = derive(frame(exposure=1.0), ["histogram"])
    given.samples = None
    write_frame(given, tmp_path / "a.exr")
    found = read_frame(tmp_path / "a.exr")
    assert np.array_equal(found.buffers["histogram"], given.buffers["histogram"])
    assert found.notes["precision"]["histogram"] == "float"
    assert found.notes["channels"]["histogram"][0] == "histogram.R00"
    assert found.notes["channels"]["histogram"][-1] == "histogram.B19"


def test_the_colours_of_a_histogram_change_places_with_those_of_the_image():
    values = np.nan_to_num(light())
    changed = sample_histogram(values[..., [2, 0, 1]])
    found = reordered(sample_histogram(values).transpose(2, 0, 1), "histogram", Change(colors=(2, 0, 1)))
    assert np.array_equal(found, changed.transpose(2, 0, 1))
