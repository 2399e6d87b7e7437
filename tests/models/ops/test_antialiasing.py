"""Antialiasing over time: blends on display values what neighbours allow."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops.antialiasing import antialiased, bounds, display, linear, rgb, ycocg
from models.ops.reproject import bilinear
from tests.models.plain_taa import taa
from tests.models.sequences import image

pytestmark = pytest.mark.usefixtures("one_thread")


def random(seed: int, height: int = 9, width: int = 8) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 3 * torch.rand(1, 3, height, width, generator=generator, dtype=torch.float64) ** 3


def still(like: Tensor) -> Tensor:
    return torch.zeros_like(like[:, :2])


def test_it_is_its_transcription() -> None:
    now, last = random(0), random(1)
    generator = torch.Generator().manual_seed(2)
    motion = 4 * (torch.rand(1, 2, 9, 8, generator=generator, dtype=torch.float64) - 0.5)
    motion[..., 0, 0] = torch.nan
    found = antialiased(now, last, bilinear(motion))
    expected = taa(image(now), image(last), image(motion))
    np.testing.assert_allclose(image(found), expected, rtol=1e-9, atol=1e-12)


def test_an_image_that_stays_as_it_is_stays() -> None:
    now = random(3)
    torch.testing.assert_close(antialiased(now, now, bilinear(still(now))), now, rtol=1e-12, atol=1e-15)


def test_a_flickering_pixel_moves_by_a_fifth_on_display_values() -> None:
    rows, columns = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
    board = ((rows + columns) % 2).double().expand(1, 3, -1, -1)  # bounds allow everything
    found = antialiased(board, 1 - board, bilinear(still(board)))
    torch.testing.assert_close(display(found), 0.2 * board + 0.8 * (1 - board))


def test_what_neighbours_do_not_show_is_forgotten() -> None:
    now = torch.full((1, 3, 6, 6), 0.3, dtype=torch.float64)
    torch.testing.assert_close(antialiased(now, random(4, 6, 6), bilinear(still(now))), now)


def test_what_comes_from_outside_stays_new() -> None:
    now, last = random(5), random(6)
    motion = still(now)
    motion[:, 0, :, 4:] = 100.0
    found = antialiased(now, last, bilinear(motion))
    assert torch.equal(found[..., 4:], now[..., 4:])
    assert not torch.equal(found[..., :4], now[..., :4])


def test_bounds_are_halfway_between_those_of_the_square_and_of_the_cross() -> None:
    corner = torch.zeros(1, 1, 5, 5)
    corner[..., 1, 1] = 8
    _, high = bounds(corner)
    assert high[0, 0].tolist() == [
        [4, 8, 4, 0, 0],
        [8, 8, 8, 0, 0],
        [4, 8, 4, 0, 0],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ]
    low, _ = bounds(-corner)
    assert torch.equal(low, -high)


@pytest.mark.parametrize("size", [(1, 1), (1, 4), (4, 1)])
def test_narrow_images_are_bounded_by_what_there_is(size: tuple[int, int]) -> None:
    now = random(7, *size)
    found = antialiased(now, now, bilinear(still(now)))
    torch.testing.assert_close(found, now)


def test_the_curve_and_the_colour_space_have_inverses() -> None:
    values = torch.tensor([0.0, 1e-30, 1e-13, 1e-12, 1e-3, 0.5, 1.0, 700.0, 1e12], dtype=torch.float64)
    torch.testing.assert_close(linear(display(values)), values, rtol=1e-12, atol=0)
    color = random(8)
    torch.testing.assert_close(rgb(ycocg(color)), color)
    assert ycocg(torch.full((1, 3, 1, 1), 0.25)).flatten().tolist() == [0.25, 0, 0]


def test_black_has_a_finite_gradient() -> None:
    now = torch.zeros(1, 3, 3, 3, requires_grad=True)
    antialiased(now, torch.zeros(1, 3, 3, 3), bilinear(torch.zeros(1, 2, 3, 3))).sum().backward()
    assert now.grad is not None
    assert now.grad.isfinite().all()
