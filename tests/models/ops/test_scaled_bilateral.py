"""The filter with scales per pixel: its transcription, its derivative, its memory, its compiled loops."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops.scaled_bilateral import BilateralRule, Pixels, scaled_bilateral
from tests.benchmarks.memory import live_bytes
from tests.models import plain_lbf
from tests.models.classical.test_nlm_forms import DEVICES, as_rows
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread")

RULE = BilateralRule((3, 1), window=3)


def pixels(
    height: int, width: int, batch: int = 1, dtype: torch.dtype = torch.float64, channels: int = 4
) -> Pixels:
    generator = torch.Generator().manual_seed(4)

    def noise(count: int) -> Tensor:
        return torch.rand(batch, count, height, width, generator=generator, dtype=torch.float64).to(dtype)

    return Pixels(noise(3), 0.02 * noise(3), noise(channels), 0.05 + noise(channels))


def scales(height: int, width: int, batch: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
    """Scales from nearly nothing to much."""
    generator = torch.Generator().manual_seed(5)
    size = (batch, 3, height, width)
    return (4 * torch.randn(size, generator=generator, dtype=torch.float64) - 2).exp().clamp_max(30).to(dtype)


def unfolded(given: Pixels, factors: Tensor, rule: BilateralRule) -> Tensor:
    """Filter with the whole windows of all pixels side by side, for autograd."""
    (batch, _, height, width), side = given.color.shape, 2 * rule.window + 1

    def windows(image: Tensor) -> Tensor:
        spread = torch.nn.functional.unfold(image, side, padding=rule.window)
        return spread.reshape(batch, image.shape[1], side**2, height, width)

    inside = windows(torch.ones_like(given.color[:, :1]))
    steps = torch.arange(-rule.window, rule.window + 1, dtype=factors.dtype)
    place = (steps[:, None].square() + steps.square()).reshape(1, 1, -1, 1, 1)
    color, variance, features = (windows(part) for part in given[:3])
    square = (color - given.color[:, :, None]).square()
    distance = square / (rule.epsilon + given.variance[:, :, None] + variance)
    each = (features - given.features[:, :, None]).square() / given.spread[:, :, None]
    exponent = rule.factor * distance.sum(1, keepdim=True) + factors[:, :1, None] * place
    for k, group in enumerate(each.split(list(rule.groups), 1)):
        exponent = exponent + factors[:, k + 1 : k + 2, None] * group.sum(1, keepdim=True)
    weight = torch.exp(-exponent) * inside
    return (weight * color).sum(2) / weight.sum(2)


@pytest.mark.parametrize("size", [(9, 11), (1, 9), (8, 1)])
def test_it_is_the_transcription_on_every_device(size: tuple[int, int]) -> None:
    given, factors = pixels(*size), scales(*size)
    color, variance, features, spread = (as_rows(part) for part in given)
    groups = [(features[..., :3], spread[..., :3]), (features[..., 3:], spread[..., 3:])]
    numbers = plain_lbf.Numbers(window=3)
    expected = plain_lbf.bilateral(color, variance, groups, as_rows(factors), numbers)
    for device in DEVICES:
        found = scaled_bilateral(Pixels(*(p.to(device) for p in given)), factors.to(device), RULE)
        assert np.abs(as_rows(found.cpu()) - expected).max() < 1e-12


def test_the_derivative_of_the_scales_is_that_of_finite_differences() -> None:
    given, factors = pixels(3, 4, 2), scales(3, 4, 2).clamp(0.01, 3).requires_grad_()
    rule = BilateralRule((3, 1), window=2)
    assert torch.autograd.gradcheck(lambda a: scaled_bilateral(given, a, rule), (factors,))


def test_the_derivative_is_that_of_whole_windows_side_by_side() -> None:
    given, factors = pixels(12, 13, 2), scales(12, 13, 2).requires_grad_()
    weights = torch.rand(2, 3, 12, 13, dtype=torch.float64)
    results = [scaled_bilateral(given, factors, RULE), unfolded(given, factors, RULE)]
    gradients = [torch.autograd.grad((x * weights).sum(), factors)[0] for x in results]
    torch.testing.assert_close(results[0], results[1], rtol=1e-12, atol=0)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-9, atol=1e-12)


def test_what_is_filtered_and_compared_has_its_gradient_too() -> None:
    factors = scales(6, 7).requires_grad_()
    given = Pixels(*(part.requires_grad_() for part in pixels(6, 7)))
    results = [scaled_bilateral(given, factors, RULE), unfolded(given, factors, RULE)]
    gradients = [torch.autograd.grad(x.square().sum(), (factors, *given)) for x in results]
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("size", [(9, 150), (17, 64), (1, 70), (40, 1)])
@pytest.mark.parametrize("wide", [False, True])
def test_compiled_loops_give_the_result_and_the_derivative_of_the_plain_form(
    size: tuple[int, int], wide: bool
) -> None:
    given, rule = pixels(*size, 2, torch.float32), BilateralRule((3, 1), window=9 if wide else 2)
    weights = torch.rand(2, 3, *size)
    results = []
    for fused in (True, False):
        factors = scales(*size, 2, torch.float32).requires_grad_()
        color = scaled_bilateral(given, factors, rule, fused=fused)
        results.append((color.detach(), torch.autograd.grad((color * weights).sum(), factors)[0]))
    exact = Pixels(*(part.double() for part in given))
    expected = scaled_bilateral(exact, scales(*size, 2, torch.float32).double(), rule)
    for color, gradient in results:
        assert largest_relative(color, expected) < 1e-5
        assert largest_relative(gradient, results[1][1]) < 1e-4
    with torch.no_grad():
        alone = scaled_bilateral(given, scales(*size, 2, torch.float32), rule, fused=True)
    assert torch.equal(alone, results[0][0])


def test_threads_do_not_change_the_result_of_compiled_loops() -> None:
    given, factors = pixels(37, 70, 1, torch.float32), scales(37, 70, 1, torch.float32)
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(scaled_bilateral(given, factors, RULE, fused=True))
    assert torch.equal(*found)


def peak_of(train: Callable[[], Tensor], fused: bool) -> int:
    """Return the most bytes of tensors, or of the arrays of compiled loops, at the same time."""
    if not fused:
        return live_bytes(train)
    tracemalloc.start()
    train()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


@pytest.mark.parametrize("fused", [True, False])
def test_memory_of_training_grows_with_the_margin_of_the_window_only(fused: bool) -> None:
    given, factors = pixels(16, 20, 1, torch.float32), scales(16, 20, 1, torch.float32).requires_grad_()

    def train(window: int = 2) -> Tensor:
        color = scaled_bilateral(given, factors, BilateralRule((3, 1), window), fused=fused)
        return torch.autograd.grad(color.sum(), factors)[0]

    train()  # compiles
    small, large = peak_of(train, fused), peak_of(lambda: train(7), fused)
    planes = 30 if fused else 10
    margins = 4 * planes * ((16 + 14) * (20 + 14) - 16 * 20)
    assert large <= small + margins
    kept = 4 * 3 * 16 * 20 * ((2 * 7 + 1) ** 2 - (2 * 2 + 1) ** 2)  # one image for each offset
    assert margins < 0.4 * kept


def test_strips_change_nothing() -> None:
    given, factors = pixels(30, 11), scales(30, 11).requires_grad_()
    whole = scaled_bilateral(given, factors, RULE)
    cut = scaled_bilateral(given, factors, RULE, budget=100)
    assert torch.equal(whole, cut)
    gradients = [torch.autograd.grad(x.square().sum(), factors)[0] for x in (whole, cut)]
    assert torch.equal(*gradients)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_stays_exactly_constant(dtype: torch.dtype) -> None:
    given = pixels(12, 14, dtype=dtype)._replace(color=torch.full((1, 3, 12, 14), 0.3, dtype=dtype))
    assert torch.equal(scaled_bilateral(given, scales(12, 14, dtype=dtype), RULE), given.color)


def test_an_impulse_spreads_as_far_as_the_window_and_as_the_weights_say() -> None:
    given = pixels(11, 11)
    zeros = torch.zeros_like(given.color)
    zeros[..., 5, 5] = 1.0
    flat = Pixels(zeros, given.variance, torch.zeros_like(given.features), given.spread)
    factors = torch.full((1, 3, 11, 11), 0.1, dtype=torch.float64)
    found = scaled_bilateral(flat, factors, BilateralRule((3, 1), window=3, factor=0.0))[0, 0]
    assert (found[2:9, 2:9] > 0).all()
    assert found.sum() == pytest.approx(float(found[2:9, 2:9].sum()))
    steps = torch.arange(-3, 4).double()
    weight = torch.exp(-0.1 * (steps[:, None].square() + steps.square()))
    torch.testing.assert_close(found[5, 5], 1 / weight.sum())
    torch.testing.assert_close(found[5, 7] / found[5, 5], torch.exp(torch.tensor(-0.4).double()))


@pytest.mark.parametrize("fused", [True, False])
def test_distances_beyond_all_range_give_weights_and_derivatives_of_zero(fused: bool) -> None:
    given = pixels(9, 10, dtype=torch.float32)
    given.color[..., 4, 5], given.features[..., 3, 3], given.variance[:] = 1e18, 1e18, 0.0
    factors = torch.full((1, 3, 9, 10), 5.0, requires_grad=True)
    found = scaled_bilateral(given, factors, RULE, fused=fused)
    assert torch.equal(found.detach(), given.color)
    (gradient,) = torch.autograd.grad(found.sum(), factors)
    assert gradient.isfinite().all()
    assert (gradient[..., 4, 5] == 0).all()


@pytest.mark.parametrize("change", [{"window": 0}, {"factor": -1.0}, {"epsilon": 0.0}])
def test_rules_that_cannot_be_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="needs a window radius >= 1, a factor >= 0 and an epsilon > 0"):
        BilateralRule((3,), **change)  # type: ignore[arg-type]
