"""Slopes of images."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops.slopes import slopes, variation


def row(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)[None, None, None]


def test_a_ramp_has_its_slope_everywhere_and_none_across() -> None:
    right, down = slopes(row(1, 3, 5, 7).expand(1, 2, 3, 4))
    assert (right == 2).all()
    assert (down == 0).all()


def test_a_cliff_is_no_slope_on_either_side() -> None:
    right, _ = slopes(row(1, 2, 3, 100, 101, 102))
    assert right.flatten().tolist() == [1, 1, 1, 1, 1, 1]


def test_the_smaller_of_both_sides_counts_with_its_sign() -> None:
    right, _ = slopes(row(0, 5, 3, 10))
    assert right.flatten().tolist() == [-2, -2, -2, -2]
    _, down = slopes(row(0, 5, 3, 10).mT)
    assert down.flatten().tolist() == [-2, -2, -2, -2]


def test_a_cliff_beside_the_last_pixel_of_a_row_is_no_slope() -> None:
    right, _ = slopes(row(100, 1, 2, 3, 50))
    assert right.flatten().tolist() == [1, 1, 1, 1, 1]
    assert slopes(row(1, 5))[0].flatten().tolist() == [4, 4]


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1)])
def test_a_side_of_one_pixel_has_no_slope(size: tuple[int, int]) -> None:
    right, down = slopes(torch.rand(1, 3, *size))
    assert (right == 0).all() == (size[1] == 1)
    assert (down == 0).all() == (size[0] == 1)


def test_variation_adds_both_directions_and_is_a_length_over_channels() -> None:
    rows, columns = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    vectors = torch.stack([columns + 2 * rows, -4 * columns])[None]
    assert (variation(vectors) == 5).all()
