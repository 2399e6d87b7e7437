"""The modulated convolution: equal to single operations, in values, gradients and what it keeps."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops import modulation
from models.ops.modulation import Weights, modulated_convolution, plain_modulated_convolution


def example(dtype: torch.dtype = torch.float64, size: int = 6) -> tuple[Tensor, Tensor, Weights]:
    torch.manual_seed(0)
    shapes = [(3, 3, 1, 1), (3,), (5, 3, 1, 1), (5,)] * 2 + [(5, 5, 3, 3), (5,)]
    weights = Weights(*(torch.randn(shape, dtype=dtype, requires_grad=True) for shape in shapes))
    maps, condition = torch.randn(2, 5, size, 7, dtype=dtype), torch.randn(2, 3, size, 7, dtype=dtype)
    return maps.requires_grad_(), condition.requires_grad_(), weights


@pytest.mark.parametrize("pixels", [5, 64, 4096])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_values_and_gradients_are_those_of_single_operations(
    pixels: int, layout: torch.memory_format, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modulation, "_PIXELS", pixels)
    maps, condition, weights = example()
    results = []
    for function in (modulated_convolution, plain_modulated_convolution):
        made = function(maps.contiguous(memory_format=layout), condition, weights)
        weighted = made * torch.linspace(-1, 1, made.numel(), dtype=made.dtype).view_as(made)
        results.append([made, *torch.autograd.grad(weighted.sum(), [maps, condition, *weights])])
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-12)


def test_gradients_agree_with_finite_differences() -> None:
    maps, condition, weights = example(size=3)

    def call(*tensors: Tensor) -> Tensor:
        return modulated_convolution(tensors[0], tensors[1], Weights(*tensors[2:]))

    assert torch.autograd.gradcheck(call, (maps, condition, *weights), fast_mode=True)


def test_without_gradients_the_values_are_the_same() -> None:
    maps, condition, weights = example()
    with torch.no_grad():
        found = modulated_convolution(maps, condition, weights)
    assert torch.equal(found, modulated_convolution(maps, condition, weights))


def test_only_wanted_gradients_are_made() -> None:
    maps, condition, weights = example()
    for weight in weights[8:]:
        weight.requires_grad_(False)
    modulated_convolution(maps, condition, weights).sum().backward()
    assert weights.convolution.grad is None
    assert weights.scale_in.grad is not None


def test_training_keeps_what_comes_in_and_nothing_else() -> None:
    kept: list[Tensor] = []
    maps, condition, weights = example()
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):  # type: ignore[func-returns-value]
        modulated_convolution(maps, condition, weights)
    known = {t.data_ptr() for t in (maps, condition, *weights)}
    assert {t.data_ptr() for t in kept} <= known


def test_under_autocast_gradients_come_back_in_the_weights_precision() -> None:
    maps, condition, weights = example(torch.float32)
    exact = plain_modulated_convolution(maps, condition, weights)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = modulated_convolution(maps, condition, weights)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), exact, rtol=0.1, atol=0.02 * float(exact.detach().abs().max()))
    found.float().sum().backward()
    assert all(w.grad is not None and w.grad.dtype == torch.float32 for w in weights)
