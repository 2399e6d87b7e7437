"""Box sums: separable, exact, self-adjoint."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from models.ops.boxes import box_sum


@pytest.mark.parametrize("size", [1, 3, 5, 7, 9, 11, 13, 15, 21])
def test_a_box_sum_equals_a_convolution_with_ones(size: int) -> None:
    maps = torch.rand(2, 3, 17, 31, dtype=torch.float64)
    kernel = torch.ones(3, 1, size, size, dtype=torch.float64)
    expected = F.conv2d(maps, kernel, padding=size // 2, groups=3)
    torch.testing.assert_close(box_sum(maps, size), expected)


def test_a_window_wider_than_the_image_sums_all_of_it() -> None:
    maps = torch.rand(1, 1, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(box_sum(maps, 13), maps.sum().expand(1, 1, 4, 5))


def test_a_box_sum_is_its_own_adjoint() -> None:
    left, right = torch.rand(2, 1, 2, 19, 23, dtype=torch.float64)
    torch.testing.assert_close((box_sum(left, 7) * right).sum(), (left * box_sum(right, 7)).sum())


def test_small_values_beside_huge_ones_keep_their_precision() -> None:
    # An integral image in float32 would return rounding noise of 1e20 on the right half.
    maps = torch.full((1, 1, 32, 64), 1e20)
    maps[..., 32:] = torch.rand(32, 32)
    exact = box_sum(maps.double(), 13)[..., 38:]
    torch.testing.assert_close(box_sum(maps, 13)[..., 38:].double(), exact, rtol=1e-6, atol=0)
