"""The gather with kernels cut at the border equals its literal form and unfold, in values and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops import kernel_blocks
from models.ops.gather_inside import gather_inside, gather_inside_rows
from tests.benchmarks.memory import peak_bytes
from tests.models.plain_kp import plain_gather_inside, unfold_gather

pytestmark = pytest.mark.usefixtures("one_thread")


def made(size: int, height: int = 15, width: int = 18, channels: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(size * height)
    image = torch.rand(2, channels, height, width, generator=generator, dtype=torch.float64) * 4
    logits = torch.randn(2, size * size, height, width, generator=generator, dtype=torch.float64) * 3
    return image, logits


@pytest.fixture(params=[1, 400, 1 << 14], ids=["row by row", "some rows", "at once"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_blocks, "_CHUNK", request.param)


def test_it_equals_the_loop_over_pixels_and_offsets() -> None:
    image, logits = made(5, 6, 7)
    expected = plain_gather_inside(image, logits, 5)
    torch.testing.assert_close(gather_inside(image, logits, 5), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(unfold_gather(image, logits, 5), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize(("size", "height", "width"), [(13, 15, 18), (13, 5, 9), (7, 16, 11), (1, 3, 4)])
def test_values_and_gradients_equal_those_of_unfold(size: int, height: int, width: int) -> None:
    image, logits = (t.requires_grad_() for t in made(size, height, width))
    weights = torch.rand_like(image)
    found, expected = gather_inside(image, logits, size), unfold_gather(image, logits, size)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    ours = torch.autograd.grad((found * weights).sum(), (image, logits))
    plain = torch.autograd.grad((expected * weights).sum(), (image, logits))
    for one, other in zip(ours, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("rows", [1, 4, 15])
def test_rows_are_those_of_the_whole_image_in_values_and_gradients(rows: int) -> None:
    image, logits = (t.requires_grad_() for t in made(7))
    parts = [
        gather_inside_rows(image, logits[:, :, first : first + rows], 7, first)
        for first in range(0, 15, rows)
    ]
    found, expected = torch.cat(parts, 2), gather_inside(image, logits, 7)
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
    ours = torch.autograd.grad(found.square().sum(), (image, logits))
    whole = torch.autograd.grad(expected.square().sum(), (image, logits))
    for one, other in zip(ours, whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_finite_differences() -> None:
    image, logits = (t.requires_grad_() for t in made(3, 3, 4, 2))
    assert torch.autograd.gradcheck(lambda i, w: gather_inside(i, w, 3), (image, logits))
    some = logits[:, :, 1:].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda i, w: gather_inside_rows(i, w, 3, 1), (image, some))


def test_an_impulse_comes_back_as_the_weights_that_meet_it() -> None:
    _, logits = made(3, 4, 5)
    image = torch.zeros(2, 1, 4, 5, dtype=torch.float64)
    image[:, :, 1, 2] = 1.0
    found = gather_inside(image, logits, 3)[0, 0]
    inside = logits[0].softmax(0)  # of pixels away from the border
    assert found[2, 2].item() == pytest.approx(inside[1, 2, 2].item(), rel=1e-12)  # from the row above
    assert found[1, 1].item() == pytest.approx(inside[5, 1, 1].item(), rel=1e-12)  # from the right
    top = logits[0, 3:, 0, 2].softmax(0)  # the first row has no taps above
    assert found[0, 2].item() == pytest.approx(top[4].item(), rel=1e-12)  # from below
    assert (found[3] == 0).all()
    assert (found[:, [0, 4]] == 0).all()


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_a_constant_image_stays_constant_for_logits_of_any_size(scale: float) -> None:
    image, logits = torch.full((2, 3, 15, 18), 1000.0), made(13)[1].float() * scale
    torch.testing.assert_close(gather_inside(image, logits, 13), image, rtol=2e-6, atol=0)


def test_neither_pass_holds_an_unfolded_image_or_a_second_set_of_weights() -> None:
    image, logits = torch.rand(1, 3, 128, 128), torch.randn(1, 169, 128, 128).requires_grad_()

    def step() -> None:
        gather_inside(image, logits, 13).sum().backward()

    size = 4 * logits.numel()  # of the logits' gradient, which is asked for
    assert peak_bytes(step) - size < 0.35 * size  # blocks of a few rows, whatever the image
    image.requires_grad_()
    logits.grad = None
    assert peak_bytes(step) - size < 0.35 * size
