"""The stills of the comparison: colour and histogram are of the same samples."""

import numpy as np

from data.frame import Frame
from tests.benchmarks.classical_frames import with_histogram


def frame(color, **more):
    parts = {"color_a": color, "color_b": 2 * color}
    return Frame({**parts, **more}, "room", 0)


def test_a_rounded_frame_gets_the_histogram_of_its_samples_and_keeps_its_own_colour():
    color = np.random.default_rng(1).uniform(0.01, 9, (4, 5, 3)).astype(np.float32)
    histogram = np.ones((4, 5, 60), np.float32)
    stored = frame(color * np.float32(1 + 2**-9))
    found = with_histogram(stored, frame(color, histogram=histogram))
    assert found.buffers["color_a"] is stored.buffers["color_a"]
    assert found.buffers["histogram"] is histogram


def test_other_samples_replace_colour_and_histogram_together():
    color = np.ones((4, 5, 3), np.float32)
    other = frame(color.copy(), histogram=np.ones((4, 5, 60), np.float32))
    other.buffers["color_b"][2, 3, 1] *= 1.01
    assert with_histogram(frame(color), other) is other
