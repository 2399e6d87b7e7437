"""Auxiliary buffers as networks read them, by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops.guides import depth_range, divisor, farthest, finite, relative_depth, unit_normal
from models.ops.precision import wide

NAN, INF = float("nan"), float("inf")


def depths(*frames: list[float]) -> Tensor:
    return torch.tensor(frames)[:, None, None]


def test_what_is_no_number_gets_the_one_that_is_asked_for() -> None:
    image = torch.tensor([NAN, INF, -INF, -2.0, 3.0])
    assert finite(image).tolist() == [0, 0, 0, -2, 3]
    assert finite(image, 1.0).tolist() == [1, 1, 1, -2, 3]


def test_normals_are_brought_to_the_unit_interval_and_clipped() -> None:
    normal = torch.tensor([-1.0, -0.5, 0.0, 1.0, 1.5, -7.0, NAN, INF, -INF])
    assert unit_normal(normal).tolist() == [0, 0.25, 0.5, 1, 1, 0, 0.5, 1, 0]


def test_depth_is_divided_by_the_largest_of_each_image() -> None:
    depth = depths([2.0, 8.0, 0.0, 4.0], [1.0, INF, NAN, -3.0])
    assert relative_depth(depth, None).flatten(1).tolist() == [[0.25, 1, 0, 0.5], [1, 0, 0, 0]]
    assert depth_range(depth).tolist() == [[0, 8], [0, 1]]


def test_depth_is_divided_by_the_largest_of_the_frame_where_that_is_given() -> None:
    given = torch.tensor([[1.0, 16.0]])
    assert relative_depth(depths([2.0, 8.0]), given).flatten().tolist() == [0.125, 0.5]
    assert farthest(depths([2.0, 8.0]), given).shape == (1, 1, 1, 1)


@pytest.mark.parametrize("given", [None, torch.zeros(1, 2), torch.full((1, 2), NAN)], ids=str)
def test_depth_of_a_frame_without_any_is_0(given: Tensor | None) -> None:
    depth = depths([0.0, NAN]).requires_grad_()
    found = relative_depth(depth, given)
    assert (found == 0).all()
    found.sum().backward()
    assert depth.grad is not None
    assert depth.grad.isfinite().all()


def test_a_crop_divides_its_depth_as_the_frame_does() -> None:
    depth = torch.rand(2, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    depth[0, 0, 0, 0] = INF
    crop = relative_depth(depth[..., 2:6, 3:7], depth_range(depth))
    assert torch.equal(crop, relative_depth(depth, None)[..., 2:6, 3:7])


def test_the_divisor_is_the_albedo_and_a_little_more() -> None:
    found = divisor(torch.tensor([0.0, 0.5, 1.0, -2.0, NAN, INF]))
    torch.testing.assert_close(found, torch.tensor([0.00316, 0.50316, 1.00316, 0.00316, 1.00316, 1.00316]))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float32, torch.float64])
def test_everything_is_computed_in_float32_or_wider(dtype: torch.dtype) -> None:
    expected = torch.float64 if dtype == torch.float64 else torch.float32
    image = torch.ones(1, 1, 2, 2, dtype=dtype)
    results = (wide(image), finite(image), unit_normal(image), relative_depth(image, None), divisor(image))
    assert {result.dtype for result in results} == {expected}
    assert wide(image).data_ptr() == image.data_ptr() or dtype != expected
