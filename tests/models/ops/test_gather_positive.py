"""The gather of neighbours with light equals its literal form and unfold, in values and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops import kernel_blocks
from models.ops.gather_positive import gather_positive
from tests.benchmarks.memory import peak_bytes
from tests.models.plain_mrkp import plain_gather_positive, unfold_positive

pytestmark = pytest.mark.usefixtures("one_thread")


def made(size: int, height: int = 15, width: int = 18) -> tuple[Tensor, Tensor]:
    """An image with black and with negative numbers, weights of which half are 0."""
    generator = torch.Generator().manual_seed(size * height)
    image = torch.randn(2, 3, height, width, generator=generator, dtype=torch.float64) + 0.5
    image[:, 1, ::2, ::3] = 0.0
    weights = torch.randn(2, size * size, height, width, generator=generator, dtype=torch.float64).relu()
    return image, weights


@pytest.mark.parametrize(("size", "height", "width"), [(5, 5, 6), (3, 2, 7), (1, 3, 4)])
def test_it_equals_the_loop_over_pixels_channels_and_taps(size: int, height: int, width: int) -> None:
    image, weights = made(size, height, width)
    expected = plain_gather_positive(image, weights, size)
    torch.testing.assert_close(gather_positive(image, weights, size), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(unfold_positive(image, weights, size), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("chunk", [1, 400, 1 << 14], ids=["row by row", "some rows", "at once"])
@pytest.mark.parametrize(("size", "height", "width"), [(5, 15, 18), (5, 3, 9), (7, 16, 11), (1, 3, 4)])
def test_values_and_gradients_equal_those_of_unfold(
    size: int, height: int, width: int, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_blocks, "_CHUNK", chunk)
    image, weights = (t.requires_grad_() for t in made(size, height, width))
    incoming = torch.rand_like(image)
    found, expected = gather_positive(image, weights, size), unfold_positive(image, weights, size)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    ours = torch.autograd.grad((found * incoming).sum(), (image, weights))
    plain = torch.autograd.grad((expected * incoming).sum(), (image, weights))
    # Where all weights that count are 0 the derivative is value / 1e-8.
    for one, other in zip(ours, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


def test_gradients_are_those_of_finite_differences() -> None:
    image, weights = made(3, 3, 4)
    image = torch.where(image.abs() < 0.01, 0.3, image)  # away from where taps begin to count
    tensors = (image.requires_grad_(), (weights + 0.1).requires_grad_())
    assert torch.autograd.gradcheck(lambda i, w: gather_positive(i, w, 3), tensors)


def test_an_impulse_is_seen_wherever_its_weight_is_not_0() -> None:
    image = torch.zeros(1, 2, 4, 5, dtype=torch.float64)
    image[0, 0, 1, 2] = 7.0
    weights = torch.zeros(1, 9, 4, 5, dtype=torch.float64)
    weights[:, 1] = 0.5  # the pixel above
    weights[:, 3] = 3.0  # the pixel to the left
    found = gather_positive(image, weights, 3)[0]
    assert found[0].nonzero().tolist() == [[1, 3], [2, 2]]
    torch.testing.assert_close(found[0, [1, 2], [3, 2]], torch.full((2,), 7.0, dtype=torch.float64))
    assert not found[1].any()


def test_channels_count_their_own_neighbours() -> None:
    image = torch.tensor([[[[2.0, 4.0]], [[0.0, 4.0]]]], dtype=torch.float64)
    weights = torch.zeros(1, 9, 1, 2, dtype=torch.float64)
    weights[:, 4:6] = 1.0  # the pixel itself and the one to the right
    expected = torch.tensor([[[[3.0, 4.0]], [[4.0, 4.0]]]], dtype=torch.float64)
    torch.testing.assert_close(gather_positive(image, weights, 3), expected, rtol=1e-7, atol=0)


def test_a_constant_image_stays_constant_borders_included() -> None:
    _, weights = made(5)
    image = torch.full((2, 3, 15, 18), 1000.0)
    found = gather_positive(image, weights.float() + 0.1, 5)
    torch.testing.assert_close(found, image, rtol=2e-6, atol=0)


def test_pixels_without_weights_and_images_without_light_are_black_with_finite_gradients() -> None:
    image, weights = (t.float().requires_grad_() for t in made(5))
    none, black = torch.zeros_like(weights).requires_grad_(), torch.zeros_like(image).requires_grad_()
    for pair in ((image, none), (black, weights), (black, none)):
        found = gather_positive(*pair, 5)
        assert not found.any()
        assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(found.sum(), pair))


def test_half_precision_is_summed_in_float32() -> None:
    image, weights = made(5)
    image, weights = image.float(), weights.bfloat16()
    found, expected = gather_positive(image, weights, 5), unfold_positive(image, weights.float(), 5)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_neither_pass_holds_an_unfolded_image_or_a_second_set_of_weights() -> None:
    image, weights = torch.rand(1, 3, 192, 192), torch.rand(1, 121, 192, 192).requires_grad_()

    def step() -> None:
        gather_positive(image, weights, 11).sum().backward()

    size = 4 * weights.numel()  # of the weights' gradient, which is asked for
    assert peak_bytes(step) - size < 0.35 * size  # a few images and blocks of a few rows
    image.requires_grad_()
    weights.grad = None
    assert peak_bytes(step) - size < 0.35 * size


def test_kernels_of_another_size_are_refused() -> None:
    image, weights = made(3)
    with pytest.raises(ValueError, match="of 5x5 kernels have shape"):
        gather_positive(image, weights, 5)
    with pytest.raises(ValueError, match="kernel size 2; expected an odd number"):
        gather_positive(image, weights[:, :4], 2)
