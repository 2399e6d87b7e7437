import pytest

from data.buffers import BUFFERS, FRAME_NUMBERS, buffer


def test_every_buffer_has_as_many_letters_as_channels():
    assert all(len(b.letters) == b.channels for b in BUFFERS.values())


def test_every_plain_buffer_has_halves_and_a_variance():
    for suffix in ("a", "b", "variance"):
        assert BUFFERS[f"color_{suffix}"].channels == 3
    assert BUFFERS["color_variance"].kind == "variance"
    assert "reference_a" not in BUFFERS


def test_no_hit_values_lie_in_the_legal_range():
    for b in BUFFERS.values():
        assert b.low is None or b.no_hit >= b.low
        assert b.high is None or b.no_hit <= b.high


def test_distances_are_not_stored_in_half_precision():
    assert not any(b.half for b in BUFFERS.values() if b.kind in ("distance", "variance"))


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown buffer 'colour'; known: color, irradiance.*_variance"):
        buffer("colour")


def test_frame_numbers_are_exposure_depth_range_and_the_lens():
    assert FRAME_NUMBERS == {"exposure": 1, "depth_range": 2, "thin_lens": 3}
