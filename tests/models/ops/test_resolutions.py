"""Halved and doubled resolutions, and equation 7."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch

from models.ops.resolutions import blended, doubled, resolutions
from tests.models.plain_mrkp import plain_doubled
from tests.models.plain_wskp_mr import mean_of_four, plain_blend


def made(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)), dtype=torch.float64)


def test_each_resolution_is_the_mean_of_four_pixels_of_the_one_before() -> None:
    image = made(2, 3, 8, 12)
    found = resolutions(image, 3)
    assert [tuple(level.shape[-2:]) for level in found] == [(8, 12), (4, 6), (2, 3)]
    for fine, coarse in pairwise(found):
        torch.testing.assert_close(coarse, mean_of_four(fine), rtol=1e-14, atol=0)
    assert torch.equal(found[0], image)


def test_blending_is_equation_7_pixel_by_pixel() -> None:
    fine, coarse, alpha = made(2, 3, 6, 8), made(2, 3, 3, 4) + 1, made(2, 1, 6, 8)
    expected = plain_blend(fine, coarse, alpha)
    torch.testing.assert_close(blended(fine, coarse, alpha), expected, rtol=1e-13, atol=1e-13)


def test_alpha_0_keeps_the_fine_image_and_alpha_1_takes_the_means_of_the_coarse_one() -> None:
    fine, coarse = made(1, 3, 6, 8), made(1, 3, 3, 4) + 1
    none = torch.zeros(1, 1, 6, 8, dtype=torch.float64)
    assert torch.equal(blended(fine, coarse, none), fine)
    taken = blended(fine, coarse, none + 1)
    torch.testing.assert_close(mean_of_four(taken), coarse, rtol=1e-13, atol=0)
    details = fine[..., ::2, ::2] - fine[..., 1::2, 1::2]
    torch.testing.assert_close(taken[..., ::2, ::2] - taken[..., 1::2, 1::2], details)


@pytest.mark.parametrize("size", [(4, 5), (1, 3), (2, 1), (1, 1)])
def test_a_doubled_image_copies_at_even_pixels_and_has_means_of_neighbours_between(
    size: tuple[int, int],
) -> None:
    image = made(2, 3, *size)
    found = doubled(image)
    assert torch.equal(found[..., ::2, ::2], image)
    torch.testing.assert_close(found, plain_doubled(image), rtol=1e-14, atol=0)


def test_an_impulse_is_doubled_to_quarters_halves_and_itself() -> None:
    image = torch.zeros(1, 1, 3, 3)
    image[..., 1, 1] = 4.0
    expected = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]])
    assert torch.equal(doubled(image)[0, 0, 1:4, 1:4], expected)
    assert doubled(image).count_nonzero() == 9


def test_a_doubled_constant_image_is_constant_borders_included() -> None:
    assert torch.equal(doubled(torch.full((1, 2, 3, 5), 0.3)), torch.full((1, 2, 6, 10), 0.3))


def test_linear_blending_is_equation_7_with_the_other_upsampling() -> None:
    fine, coarse, alpha = made(2, 3, 6, 8), made(2, 3, 3, 4) + 1, 3 * made(2, 1, 6, 8)
    expected = fine - alpha * plain_doubled(mean_of_four(fine)) + alpha * plain_doubled(coarse)
    torch.testing.assert_close(blended(fine, coarse, alpha, "linear"), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("upsampling", ["nearest", "linear"])
def test_gradients_are_those_of_finite_differences(upsampling: Any) -> None:
    tensors = [t.requires_grad_() for t in (made(1, 2, 4, 6), made(1, 2, 2, 3), made(1, 1, 4, 6))]
    assert torch.autograd.gradcheck(lambda *images: blended(*images, upsampling), tensors)


def test_half_precision_is_combined_in_float32() -> None:
    parts = [t.bfloat16() for t in (made(1, 3, 4, 4), made(1, 3, 2, 2), made(1, 1, 4, 4))]
    assert blended(*parts).dtype == torch.float32
    assert resolutions(parts[0], 2)[1].dtype == torch.float32
