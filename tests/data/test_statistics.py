import numpy as np
import pytest

from data.frame import Frame
from data.frames import FrameSet
from data.sample import SAMPLES
from data.statistics import (
    ALBEDO,
    RADIANCE,
    Scale,
    energy,
    firefly_mask,
    histogram,
    histograms,
    no_hit_share,
    outside_share,
)


def frame(**buffers):
    return Frame({n: np.asarray(b, np.float32) for n, b in buffers.items()}, "scene", 0)


def test_every_value_is_counted_once_inside_or_outside_of_the_bins():
    values = np.array([0, 0, -1, 1e-9, 1e-3, 0.5, 1, 20, 1e9, np.nan, np.inf], np.float32)
    h = histogram(values, RADIANCE)
    assert (h.zero, h.below, h.above, h.counts.sum(), h.total) == (2, 2, 1, 4, 9)
    assert np.flatnonzero(h.counts).tolist() == [10, 36, 40, 53]


def test_the_last_bin_holds_its_right_edge():
    h = histogram(np.array([0, 0.999, 1, 1.001], np.float32), ALBEDO)
    assert (h.counts[0], h.counts[-1], h.above) == (1, 2, 1)


def test_histograms_of_two_frames_add_up_to_that_of_both():
    values = np.random.default_rng(0).lognormal(size=(2, 500)).astype(np.float32)
    both, sum_ = histogram(values, RADIANCE), histogram(values[0], RADIANCE) + histogram(values[1], RADIANCE)
    np.testing.assert_array_equal(both.counts, sum_.counts)
    assert both.total == sum_.total == 1000
    with pytest.raises(ValueError, match="cannot be added"):
        both + histogram(values, Scale(0, 1, 2))


def test_depth_and_normals_without_a_hit_are_not_counted():
    found = histograms(frame(depth=[[[0], [2]]], normal=[[[0, 0, 0], [0, 0.6, 0.8]]]))
    assert found["depth"].total == found["normal"].total == 1
    assert found["normal"].counts[50] == 1


def test_a_firefly_is_ten_times_as_bright_as_reference_and_a_tenth_of_its_median():
    reference = np.full((4, 4, 3), 2, np.float32)
    reference[0, 0] = 0
    color = reference.copy()
    color[0, 0], color[1, 1] = 2.05, 22.1
    color[2, 2], color[3, 3] = 1.95, 21.9
    assert np.argwhere(firefly_mask(color, reference)).tolist() == [[0, 0], [1, 1]]


def test_fireflies_of_a_real_frame_are_the_share_that_the_data_set_states():
    # Stated by those who rendered it: 0.82 % on average over the frames of this scene.
    b = FrameSet(SAMPLES["bmfr"]).read("classroom", 0).buffers
    assert firefly_mask(b["color"], b["reference"]).mean() == pytest.approx(0.0082, abs=0.0005)


def test_misses_come_from_the_hit_buffer_where_there_is_one():
    depth = np.array([[[0], [1], [1], [1]]])
    assert no_hit_share(frame(depth=depth)) == 0.25
    assert no_hit_share(frame(depth=depth, hit=np.full((1, 4, 1), 0.9))) == pytest.approx(0.1)
    assert no_hit_share(frame(color=np.ones((1, 1, 3)))) is None


def test_values_beyond_the_legal_range_are_counted():
    assert outside_share("albedo", np.array([[[0.5, 1.0, 1.2]]], np.float32)) == pytest.approx(1 / 3)
    assert outside_share("diffuse_albedo", np.array([[[-0.1, 0.5, 1.0]]], np.float32)) == pytest.approx(1 / 3)
    assert outside_share("color", np.array([[[-0.1, 50, 1e4]]], np.float32)) == pytest.approx(1 / 3)
    assert outside_share("position", np.array([[[-1e6, 0, 1e6]]], np.float32)) == 0


def noisy(bias, spp=16):
    generator = np.random.default_rng(3)
    reference = np.ones((64, 64, 3))
    color = reference * bias + generator.normal(scale=0.5, size=reference.shape)
    made = frame(color=color, reference=reference, color_variance=np.full_like(reference, 0.25))
    made.spp = spp
    return made


def test_the_energy_score_tells_a_bias_from_noise():
    fair, biased = energy(noisy(1.0)), energy(noisy(1.1))
    assert abs(fair.z) < 4
    # 0.1 over a standard error of 0.5 / 64
    assert biased.z == pytest.approx(0.1 / (0.5 / 64), rel=0.3)
    assert biased.ratio == pytest.approx(1.1, abs=0.02)


def test_a_noisy_reference_widens_the_standard_error():
    frame_ = noisy(1.1)
    assert energy(frame_, reference_spp=16).z == pytest.approx(energy(frame_).z / np.sqrt(2))


def test_energy_without_variance_has_no_score_and_without_reference_no_answer():
    made = noisy(1.0)
    del made.buffers["color_variance"]
    assert energy(made).z is None
    del made.buffers["reference"]
    assert energy(made) is None
    assert energy(frame(color=np.ones((2, 2, 3)), reference=np.zeros((2, 2, 3)))) is None
