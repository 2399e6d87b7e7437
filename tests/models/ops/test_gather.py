"""The streamed gather equals unfold, softmax and sum, in values and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from models.ops import gather as module
from models.ops.gather import Border, gather, gather_padded
from tests.benchmarks.memory import peak_bytes
from tests.models.plain_kpcn import plain_gather


def made(
    size: int, height: int = 13, width: int = 17, channels: int = 3, batch: int = 2
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(size * height)
    image = torch.rand(batch, channels, height, width, generator=generator, dtype=torch.float64) * 4
    logits = torch.randn(batch, size * size, height, width, generator=generator, dtype=torch.float64) * 3
    return image, logits


@pytest.fixture(params=[1, 40, 1 << 14], ids=["row by row", "two rows", "at once"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK", request.param * 2)


def test_one_pixel_by_hand() -> None:
    image = torch.tensor([[[[1.0, 2, 3], [4, 5, 6], [7, 8, 9]]]])
    logits = torch.full((1, 9, 3, 3), -1e4)
    logits[0, 2, 1, 1] = math.log(3.0)  # above to the right: 3
    logits[0, 7, 1, 1] = 0.0  # below: 8
    assert gather(image, logits, 3)[0, 0, 1, 1].item() == pytest.approx(0.75 * 3 + 0.25 * 8)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("border", ["reflect", "zero"])
@pytest.mark.parametrize(("size", "channels"), [(1, 2), (3, 1), (7, 3), (21, 4)])
def test_it_equals_unfold_softmax_and_sum(size: int, channels: int, border: Border) -> None:
    image, logits = made(size, channels=channels)
    expected = plain_gather(image, logits, size, border)
    torch.testing.assert_close(gather(image, logits, size, border), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("border", ["reflect", "zero"])
def test_gradients_equal_those_of_the_plain_form(border: Border) -> None:
    image, logits = (t.requires_grad_() for t in made(7))
    weights = torch.rand_like(image)
    expected = torch.autograd.grad((plain_gather(image, logits, 7, border) * weights).sum(), (image, logits))
    found = torch.autograd.grad((gather(image, logits, 7, border) * weights).sum(), (image, logits))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)


def test_gradients_are_those_of_finite_differences() -> None:
    image, logits = (t.requires_grad_() for t in made(3, 4, 5, 2, 1))
    assert torch.autograd.gradcheck(lambda i, w: gather(i, w, 3), (image, logits))
    assert torch.autograd.gradcheck(lambda w: gather(image.detach(), w, 3), (logits,))
    assert torch.autograd.gradcheck(lambda i: gather(i, logits.detach(), 3), (image,))


@pytest.mark.parametrize("value", [0.3, 1000.0])
def test_a_constant_image_stays_constant_when_mirrored_and_darkens_at_the_border_with_zeros(
    value: float,
) -> None:
    logits = made(21)[1].float()
    image = torch.full((2, 3, 13, 17), value)
    torch.testing.assert_close(gather(image, logits, 21), image, rtol=2e-6, atol=0)
    zero = gather(image, logits, 21, "zero")
    assert (zero < image).all()


def test_half_precision_logits_are_weighed_in_float32() -> None:
    image, logits = made(7)
    short = logits.bfloat16().requires_grad_()
    found = gather(image.float(), short, 7)
    assert found.dtype == torch.float32
    expected = plain_gather(image.float(), short.detach().float(), 7)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    found.sum().backward()
    assert short.grad is not None
    assert short.grad.dtype == torch.bfloat16


def test_logits_of_any_size_stay_finite() -> None:
    image, logits = made(5)
    huge = (logits.float() * 1e6).requires_grad_()
    result = gather(image.float(), huge, 5)
    result.sum().backward()
    assert result.isfinite().all()
    assert huge.grad is not None
    assert huge.grad.isfinite().all()


def test_no_unfolded_image_and_no_second_set_of_weights_is_kept() -> None:
    image, logits = torch.rand(1, 3, 256, 256), torch.randn(1, 49, 256, 256)
    logits.requires_grad_()
    size = logits.numel() * logits.element_size()
    ours = peak_bytes(lambda: gather(image, logits, 7).sum().backward())
    logits.grad = None
    plain = peak_bytes(lambda: plain_gather(image, logits, 7).sum().backward())
    assert ours < 2.3 * size  # the gradient of the logits and strips
    assert plain > 6 * size


def test_the_padded_form_needs_no_border() -> None:
    image, logits = made(5)
    whole = torch.nn.functional.pad(image, [2] * 4, mode="reflect")
    assert torch.equal(gather_padded(whole, logits, 5), gather(image, logits, 5))


def test_wrong_arguments_are_named() -> None:
    image, logits = made(5)
    with pytest.raises(ValueError, match=r"kernel size 4; expected an odd number"):
        gather(image, logits, 4)
    with pytest.raises(ValueError, match=r"logits have shape \(2, 25, 13, 17\), expected \(2, 9, 13, 17\)"):
        gather(image, logits, 3)
    with pytest.raises(ValueError, match=r"17x13 cannot be mirrored by 14 pixels.*15 rows"):
        gather(image, torch.zeros(2, 29 * 29, 13, 17), 29)
    with pytest.raises(ValueError, match="border 'wrap'"):
        gather(image, logits, 5, "wrap")  # type: ignore[arg-type]
