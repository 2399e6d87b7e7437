"""What counts as finite, and what is replaced."""

import numpy as np
import pytest

from data.repair import all_finite, repair

EVERY_HALF = np.arange(65536, dtype=np.uint16).view(np.float16)


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_every_half_precision_number_is_called_finite_as_isfinite_does(kind) -> None:
    values = EVERY_HALF.astype(kind)
    assert [all_finite(v) for v in values[::7, None]] == np.isfinite(values[::7]).tolist()
    assert all_finite(values[np.isfinite(values)])


@pytest.mark.parametrize("value", [np.nan, -np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_one_broken_value_is_found_in_any_order_of_memory(value: float, kind) -> None:
    image = np.full((5, 7, 3), -1, kind)
    for array in (image, image.transpose(2, 0, 1), np.asfortranarray(image)):
        assert all_finite(array)
    image[4, 6, 2] = value
    for array in (image, image.transpose(2, 0, 1), np.asfortranarray(image), image[::2, ::2]):
        assert not all_finite(array)


def test_an_empty_array_is_finite() -> None:
    assert all_finite(np.empty((0, 3), np.float32))


def test_buffers_that_are_finite_are_passed_on_and_broken_ones_counted() -> None:
    fine = np.ones((4, 4, 3), np.float32)
    broken = fine.copy()
    broken[1, 1, 0] = np.nan
    buffers, counts = repair({"color": broken, "albedo": fine, "normal": broken})
    assert counts == {"color": 1, "normal": 1}
    assert buffers["albedo"] is fine
    assert np.array_equal(buffers["color"], fine)
    assert np.array_equal(buffers["normal"][1, 1], [0, 0, 0])
