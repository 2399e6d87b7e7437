"""Fireflies go, highlights stay."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops.fireflies import limited_halves
from models.ops.halves import Halves

PLACE = (..., 6, 7)


def flat(value: float = 1.0) -> Halves:
    image = torch.full((1, 3, 13, 15), value)
    return Halves(image.clone(), image.clone(), 0.01 * image)


def bright(halves: Halves, rows: slice, columns: slice, *which: Tensor) -> Halves:
    for half in which:
        half[..., rows, columns] = torch.tensor([80.0, 40.0, 8.0])[:, None, None]
    halves.variance[..., rows, columns] = 400.0
    return halves


def test_a_pixel_that_one_half_knows_nothing_of_comes_down_to_twice_its_neighbours() -> None:
    halves = flat()
    bright(halves, slice(6, 7), slice(7, 8), halves.a)
    found = limited_halves(halves)
    torch.testing.assert_close(found.a[PLACE], torch.tensor([[2.0, 1.0, 0.2]]))  # its colour stays
    torch.testing.assert_close(found.b, halves.b)
    share = (found.a + found.b)[PLACE] / (halves.a + halves.b)[PLACE]
    torch.testing.assert_close(found.variance[PLACE], 400.0 * share.square())
    elsewhere = torch.ones(13, 15, dtype=torch.bool)
    elsewhere[6, 7] = False
    for old, new in zip(halves, found, strict=True):
        assert torch.equal(old[..., elsewhere], new[..., elsewhere])


@pytest.mark.parametrize("size", [1, 2, 3])
def test_what_both_halves_show_stays_whatever_its_size(size: int) -> None:
    halves = flat()
    bright(halves, slice(6, 6 + size), slice(7, 7 + size), halves.a, halves.b)
    for old, new in zip(halves, limited_halves(halves), strict=True):
        torch.testing.assert_close(new, old)


def test_a_line_of_which_each_half_has_every_other_pixel_stays() -> None:
    halves = flat()
    for column in range(15):
        bright(halves, slice(6, 7), slice(column, column + 1), halves.a if column % 2 else halves.b)
    for old, new in zip(halves, limited_halves(halves), strict=True):
        torch.testing.assert_close(new, old)


def test_black_images_stay_black_and_gradients_finite() -> None:
    halves = flat(0.0)
    halves.a[PLACE] = 9.0
    found = limited_halves(halves)
    assert not found.a.any()
    tracked = Halves(halves.a.requires_grad_(), halves.b.requires_grad_(), halves.variance)
    sum(part.sum() for part in limited_halves(tracked)).backward()  # type: ignore[union-attr]
    assert tracked.a.grad is not None
    assert tracked.a.grad.isfinite().all()
    assert tracked.b.grad is not None
    assert tracked.b.grad.isfinite().all()


def test_frames_and_images_of_a_batch_are_limited_by_themselves() -> None:
    halves = flat()
    bright(halves, slice(6, 7), slice(7, 8), halves.a)
    other = flat(100.0)
    both = Halves(*(torch.stack([x, y], 1) for x, y in zip(halves, other, strict=True)))
    for frame, alone in enumerate((halves, other)):
        for found, expected in zip(limited_halves(both), limited_halves(alone), strict=True):
            assert torch.equal(found[:, frame], expected)
