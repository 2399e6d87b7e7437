"""Splatting into bilateral grids and reading them equal the formulas, in values and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from models.ops import grid_cells
from models.ops.bilateral_grid import create_grid, slice_grid
from models.ops.grid_cells import Cells
from tests.models.frames import largest_relative
from tests.models.plain_nbgd import indexed_grid, indexed_slice, literal_grid, literal_slice

pytestmark = pytest.mark.usefixtures("one_thread")

SIZES = [Cells(4, 4), Cells(8, 8), Cells(16, 16), Cells(2, 128), Cells(5, 32)]


def made(cells: Cells, batch: int = 2, down: int = 2, across: int = 3, channels: int = 3) -> list[Tensor]:
    """An image with black pixels and a guide over its whole range, in float64."""
    generator = torch.Generator().manual_seed(cells.space * cells.depth)
    size = (down * cells.space, across * cells.space)
    image = torch.rand(batch, channels, *size, generator=generator, dtype=torch.float64) * 4
    image[..., :3, :5] = 0.0
    guide = torch.rand(batch, 1, *size, generator=generator, dtype=torch.float64) * 255
    guide[..., 0, :4] = torch.tensor([0.0, 255.0, 0.2, 254.9])
    return [image, guide]


@pytest.fixture(params=[1, 40, 1 << 14], ids=["row by row", "some rows", "at once"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid_cells, "_CHUNK", request.param)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("cells", SIZES, ids=str)
def test_grids_and_what_is_read_equal_the_formulas(cells: Cells) -> None:
    image, guide = made(cells)
    expected = literal_grid(image, guide, *cells)
    torch.testing.assert_close(create_grid(image, guide, cells), expected, rtol=1e-12, atol=1e-12)
    other = made(cells)[1].flip(2)
    read = literal_slice(expected, other, *cells)
    torch.testing.assert_close(slice_grid(expected, other, cells), read, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("cells", SIZES, ids=str)
def test_gradients_equal_those_of_the_formulas(cells: Cells) -> None:
    inputs = [tensor.requires_grad_() for tensor in made(cells)]
    image, guide = inputs
    weights = torch.rand(image.shape, dtype=torch.float64)
    literal = literal_slice(literal_grid(image, guide, *cells), guide, *cells)
    expected = torch.autograd.grad((literal * weights).sum(), inputs)
    ours = slice_grid(create_grid(image, guide, cells), guide, cells)
    found = torch.autograd.grad((ours * weights).sum(), inputs)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-11)


def test_the_form_with_index_arrays_equals_the_formulas() -> None:
    image, guide = made(Cells(8, 8))
    grid = indexed_grid(image, guide, 8, 8)
    torch.testing.assert_close(grid, literal_grid(image, guide, 8, 8), rtol=1e-12, atol=1e-12)
    read = literal_slice(grid, guide, 8, 8)
    torch.testing.assert_close(indexed_slice(grid, guide, 8, 8), read, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
def test_gradients_are_those_of_finite_differences(wanted: tuple[bool, bool]) -> None:
    cells = Cells(4, 64)
    image, guide = made(cells, 1, 1, 2, 2)
    grid = torch.rand(1, 2, 1, 2, 4, dtype=torch.float64) + 0.1
    guide[..., 0, :4] = torch.tensor([10.0, 200.0, 90.0, 130.0])

    def asked(*tensors: Tensor) -> list[Tensor]:
        return [tensor.clone().requires_grad_(want) for tensor, want in zip(tensors, wanted, strict=True)]

    assert torch.autograd.gradcheck(lambda i, g: create_grid(i, g, cells), asked(image, guide))
    assert torch.autograd.gradcheck(lambda i, g: slice_grid(i, g, cells), asked(grid, guide))


def impulse() -> tuple[Tensor, Tensor, Cells]:
    """8x8 black pixels, the one at row 1, column 5 is 8; the guide lies in the middle of the second cell."""
    image = torch.zeros(1, 1, 8, 8, dtype=torch.float64)
    image[..., 1, 5] = 8.0
    return image, torch.full_like(image, 1.5 * 64 - 0.5), Cells(4, 64)


def test_one_pixel_splatted_by_hand() -> None:
    image, guide, cells = impulse()
    found = create_grid(image, guide, cells)[0, 0, ..., 1]
    # Row 1 weighs 7/8 in the first row of cells; column 5 weighs 1/8 in the first column, 7/8 in the second.
    # All weights of a row (column) add up to 5/8 + 7/8 + 7/8 + 5/8 + 3/8 + 1/8 = 7/2.
    first = 8 * (7 / 8) * torch.tensor([1 / 8, 7 / 8], dtype=torch.float64) / 3.5**2
    torch.testing.assert_close(found[0], first, rtol=1e-5, atol=0)
    assert not found[1].any()


def test_a_cell_is_read_by_hand() -> None:
    _, guide, cells = impulse()
    grid = torch.zeros(1, 1, 2, 2, 4, dtype=torch.float64)
    grid[..., 0, 0, 1], grid[..., 0, 1, 1], grid[..., 1, 0, 1] = 2.0, 6.0, 4.0
    found = slice_grid(grid, guide, cells)[0, 0]
    assert found[0, 0].item() == pytest.approx(2.0)
    assert found[0, 4].item() == pytest.approx(3 / 8 * 2 + 5 / 8 * 6, rel=1e-6)
    # Column 4 weighs 3/8 and 5/8, row 5 1/8 and 7/8; the fourth cell holds nothing and does not count.
    weights = torch.tensor([3 / 8 * 1 / 8, 5 / 8 * 1 / 8, 3 / 8 * 7 / 8])
    expected = (weights * torch.tensor([2.0, 6.0, 4.0])).sum() / weights.sum()
    assert found[5, 4].item() == pytest.approx(expected.item(), rel=1e-6)


def test_between_two_levels_both_cells_have_a_part() -> None:
    image, guide, cells = impulse()
    grid = create_grid(image, guide + 16, cells)[0, 0, 0, 1]
    assert grid[1].item() == pytest.approx(grid[2].item(), rel=1e-5)  # means, whatever the common weight
    assert grid[0] == grid[3] == 0
    grid = torch.tensor([0.0, 1.0, 5.0, 0.0], dtype=torch.float64).expand(1, 1, 2, 2, 4)
    read = slice_grid(grid, guide + 16, cells)
    torch.testing.assert_close(read, torch.full_like(read, 0.75 * 1 + 0.25 * 5), rtol=1e-5, atol=0)


def test_cells_that_are_black_in_a_channel_do_not_count_in_that_channel() -> None:
    _, guide, cells = impulse()
    grid = torch.rand(1, 2, 2, 2, 4, dtype=torch.float64) + 1
    grid[:, 0, 0, 1] = 0.0
    found = slice_grid(grid, guide, cells)[0]
    assert found[0, 0, 4] == pytest.approx(float(grid[0, 0, 0, 0, 1]))
    assert found[1, 0, 4] == pytest.approx(float(3 / 8 * grid[0, 1, 0, 0, 1] + 5 / 8 * grid[0, 1, 0, 1, 1]))
    assert not slice_grid(torch.zeros_like(grid), guide, cells).any()
    assert torch.equal(slice_grid(-grid, guide, cells), torch.zeros_like(found)[None])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cells", SIZES, ids=str)
def test_a_constant_image_stays_constant_borders_included(cells: Cells, dtype: torch.dtype) -> None:
    guide = made(cells, down=3)[1].to(dtype)
    image = torch.full((2, 3, *guide.shape[2:]), 3.7, dtype=dtype)
    found = slice_grid(create_grid(image, guide, cells), guide, cells)
    torch.testing.assert_close(found, image, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0)


def test_inference_and_training_give_the_same_bits() -> None:
    image, guide = (tensor.float() for tensor in made(Cells(8, 8)))
    grid = create_grid(image, guide, Cells(8, 8))
    assert torch.equal(create_grid(image, guide.requires_grad_(), Cells(8, 8)), grid)
    assert torch.equal(slice_grid(grid, guide, Cells(8, 8)), slice_grid(grid, guide.detach(), Cells(8, 8)))


def test_elements_of_gradients_above_the_limit_become_0_and_no_others() -> None:
    cells = Cells(8, 8)
    image, guide = (tensor.requires_grad_() for tensor in made(cells))
    grid = create_grid(image.detach(), guide.detach(), cells).requires_grad_()
    for operator, first in ((create_grid, image), (slice_grid, grid)):
        exact = torch.autograd.grad(operator(first, guide, cells).square().sum(), (first, guide))
        for one in exact:
            limit = float(one.abs().flatten().median()) * 1.001
            cut = torch.autograd.grad(operator(first, guide, cells, limit).square().sum(), (first, guide))
            for found, whole in zip(cut, exact, strict=True):
                assert torch.equal(found, torch.where(whole.abs() > limit, 0.0, whole))
        assert float((cut[1] == 0).double().mean()) > 0.2


@pytest.mark.parametrize("value", [0.0, 65504.0, 1e12])
def test_fireflies_and_black_stay_finite_with_their_gradients(value: float) -> None:
    image, guide = (tensor.float() for tensor in made(Cells(16, 16)))
    image.zero_()
    image[..., ::7, ::5] = value
    inputs = [image.requires_grad_(), guide.requires_grad_()]
    color = slice_grid(create_grid(image, guide, Cells(16, 16)), guide, Cells(16, 16))
    assert color.isfinite().all()
    assert color.max() <= value * (1 + 1e-5)
    assert all(g.isfinite().all() for g in torch.autograd.grad(color.mean(), inputs))


def test_low_precision_is_computed_in_float32() -> None:
    cells = Cells(8, 8)
    image, guide = (tensor.bfloat16() for tensor in made(cells))
    with torch.autocast("cpu", torch.bfloat16):
        found = slice_grid(create_grid(image, guide, cells), guide, cells)
    exact = literal_slice(literal_grid(image.double(), guide.double(), 8, 8), guide.double(), 8, 8)
    assert found.dtype == torch.float32
    assert largest_relative(found, exact) < 1e-5


def test_guides_that_are_no_numbers_harm_only_the_cells_around_them() -> None:
    cells = Cells(4, 4)
    image, guide = made(cells, down=6, across=6)
    guide[0, 0, 2, 2] = math.nan
    found = slice_grid(create_grid(image, guide, cells), guide, cells)
    assert found[0, :, 2, 2].isnan().all()
    assert found[0, :, 12:].isfinite().all()
    assert found[1].isfinite().all()


@pytest.mark.parametrize("cells", SIZES[:3], ids=str)
def test_a_recorded_graph_gives_the_same_at_other_sizes(cells: Cells) -> None:
    def run(image: Tensor, guide: Tensor) -> Tensor:
        return slice_grid(create_grid(image, guide, cells), guide, cells)

    small, large = made(cells), made(cells, 3, 4, 1)
    with pytest.warns(DeprecationWarning, match="torch.jit.trace"):
        traced = torch.jit.trace(run, tuple(small), check_trace=False)
    torch.testing.assert_close(traced(*large), run(*large), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("cells", "size", "message"),
    [
        (Cells(0, 4), (8, 8), "cells of 0 pixels"),
        (Cells(4, 3), (8, 8), "levels that divide 256"),
        (Cells(4, 256), (8, 8), "into two cells or more"),
        (Cells(4, 4), (8, 10), "10x8; expected sides that are multiples of 4"),
    ],
)
def test_impossible_cells_and_sizes_are_refused(cells: Cells, size: tuple[int, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        create_grid(torch.rand(1, 3, *size), torch.rand(1, 1, *size), cells)


def test_guides_and_grids_that_do_not_fit_are_refused() -> None:
    image, guide = torch.rand(2, 3, 8, 8), torch.rand(2, 1, 8, 8)
    with pytest.raises(ValueError, match=r"guide has shape \(2, 1, 8, 4\), expected \(2, 1, 8, 8\)"):
        create_grid(image, guide[..., :4], Cells(4, 4))
    with pytest.raises(ValueError, match=r"expected \(1, 1, 8, 8\)"):
        create_grid(image[:1], guide, Cells(4, 4))
    grid = create_grid(image, guide, Cells(4, 4))
    with pytest.raises(ValueError, match=r"grid has shape \(2, 3, 2, 2, 63\), expected \(2, 3, 2, 2, 64\)"):
        slice_grid(grid[..., 1:], guide, Cells(4, 4))
    with pytest.raises(ValueError, match=r"grid has shape \(1, 3"):
        slice_grid(grid[:1], guide, Cells(4, 4))
