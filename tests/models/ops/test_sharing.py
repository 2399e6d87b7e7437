"""The separable weight-sharing reconstruction equals the window softmax, for every importance."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from models.ops import sharing
from models.ops.sharing import reconstruct, reconstruct_by_softmax
from models.ops.window import SPAN, log_maps
from tests.models.frames import largest_relative

SIZES = (3, 5, 7, 9, 11, 13)


def random_maps(
    height: int, width: int, spread: float = 3.0, batch: int = 2
) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(height * width)
    irradiance = torch.rand(batch, 3, height, width, generator=generator, dtype=torch.float64) * 4
    log_importance = torch.randn(batch, 6, height, width, generator=generator, dtype=torch.float64) * spread
    fusion = torch.randn(batch, 6, height, width, generator=generator, dtype=torch.float64)
    return irradiance, log_importance, fusion


def step(low: float, high: float) -> Callable[[Tensor], Tensor]:
    """Left half at `low`, right half at `high`."""

    def shift(log_importance: Tensor) -> Tensor:
        half = log_importance.shape[-1] // 2
        level = torch.full_like(log_importance, low)
        level[..., half:] = high
        return log_importance + level

    return shift


def stretched(maps: Tensor, span: float) -> Tensor:
    low, high = maps.amin((-2, -1), keepdim=True), maps.amax((-2, -1), keepdim=True)
    return (maps - low) / (high - low) * span


RANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "narrow": lambda maps: maps,
    "just inside one band": lambda maps: stretched(maps, SPAN - 1),
    "just over one band": lambda maps: stretched(maps, SPAN + 1),
    "left -200, right +200": step(-200.0, 200.0),
    "left +1000, right -1000": step(1000.0, -1000.0),
    "noise of +-1000": lambda maps: maps * 300,
    "one pixel at +1e5": lambda maps: maps + 1e5 * (maps == maps.amax((-2, -1), keepdim=True)),
    "maps far from each other": lambda maps: maps + torch.tensor([0, 0, 900.0, 0, -900, 0])[:, None, None],
    "ramp over ten bands": lambda maps: (
        maps + torch.linspace(-5 * SPAN, 5 * SPAN, maps.shape[-1], dtype=maps.dtype)
    ),
}


def by_triple_loop(
    irradiance: Tensor, log_importance: Tensor, fusion: Tensor, sizes: tuple[int, ...]
) -> Tensor:
    """The formula pixel by pixel, in Python floats; one image."""
    _, height, width = irradiance.shape
    shares = torch.softmax(fusion, 0)
    result = torch.zeros_like(irradiance)
    for y in range(height):
        for x in range(width):
            for index, size in enumerate(sizes):
                radius = size // 2
                window = [
                    (v, u)
                    for v in range(max(0, y - radius), min(height, y + radius + 1))
                    for u in range(max(0, x - radius), min(width, x + radius + 1))
                ]
                largest = max(float(log_importance[index, v, u]) for v, u in window)
                weights = [math.exp(float(log_importance[index, v, u]) - largest) for v, u in window]
                for channel in range(3):
                    values = (
                        w * float(irradiance[channel, v, u])
                        for w, (v, u) in zip(weights, window, strict=True)
                    )
                    filtered = sum(values) / sum(weights)
                    result[channel, y, x] += shares[index, y, x] * filtered
    return result


def test_the_reference_is_the_formula_pixel_by_pixel() -> None:
    irradiance, log_importance, fusion = random_maps(6, 7, batch=1)
    expected = by_triple_loop(irradiance[0], log_importance[0, :3], fusion[0, :3], (3, 5, 13))
    found = reconstruct_by_softmax(irradiance, log_importance[:, :3], fusion[:, :3], (3, 5, 13))[0]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", RANGES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_equal_the_window_softmax_for(name: str, dtype: torch.dtype) -> None:
    irradiance, log_importance, fusion = random_maps(19, 30)
    inputs = [t.to(dtype) for t in (irradiance, RANGES[name](log_importance), fusion)]
    fast = [t.clone().requires_grad_() for t in inputs]
    exact = [t.double().requires_grad_() for t in inputs]
    weights = torch.rand(irradiance.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found, expected = reconstruct(*fast, SIZES), reconstruct_by_softmax(*exact, SIZES)
    found.backward(weights.to(dtype))
    expected.backward(weights)
    tolerance = 1e-12 if dtype == torch.float64 else 3e-6
    assert largest_relative(found, expected) < tolerance
    # Where one pixel takes a whole window, gradients of its importance are differences of terms as large as
    # the gradients of irradiance: that is the scale of rounding.
    gradients = [(one.grad, other.grad) for one, other in zip(fast, exact, strict=True)]
    scale = max(float(other.abs().max()) for _, other in gradients if other is not None)
    for one, other in gradients:
        assert one is not None
        assert other is not None
        assert (one.double() - other).abs().max() < tolerance * scale


@pytest.mark.parametrize("spread", [1.0, 60.0])
def test_the_backward_pass_agrees_with_finite_differences(spread: float) -> None:
    irradiance, log_importance, fusion = random_maps(4, 5, spread, batch=1)
    inputs = [irradiance, log_importance[:, :2].contiguous(), fusion[:, :2].contiguous()]
    assert torch.autograd.gradcheck(
        lambda *maps: reconstruct(*maps, (3, 5)), [t.requires_grad_() for t in inputs]
    )


def test_inference_and_training_give_the_same_bits() -> None:
    maps = [t.float() for t in random_maps(40, 33, spread=30.0)]
    with torch.no_grad():
        inference = reconstruct(*maps, SIZES)
    training = reconstruct(maps[0], maps[1].requires_grad_(), maps[2], SIZES)
    assert torch.equal(inference, training)


def test_chunks_of_rows_and_samples_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = [t.float() for t in random_maps(53, 20, batch=5)]
    whole = reconstruct(*maps, SIZES)
    monkeypatch.setattr(sharing, "_CHUNK", 400)
    assert torch.equal(reconstruct(*maps, SIZES), whole)


def test_a_constant_image_stays_constant_up_to_the_border() -> None:
    _, log_importance, fusion = random_maps(16, 17, spread=40.0)
    image = torch.full((2, 3, 16, 17), 3.7)
    torch.testing.assert_close(reconstruct(image, log_importance.float(), fusion.float(), SIZES), image)


def test_a_sample_does_not_depend_on_the_others_importance() -> None:
    irradiance, log_importance, fusion = (t.float() for t in random_maps(18, 18))
    log_importance[1] *= 500
    together = reconstruct(irradiance, log_importance, fusion, SIZES)
    alone = reconstruct(irradiance[:1], log_importance[:1], fusion[:1], SIZES)
    assert torch.equal(together[:1], alone)


def test_low_precision_input_is_computed_in_float32() -> None:
    maps = [t.bfloat16() for t in random_maps(16, 16)]
    found = reconstruct(*maps, SIZES)
    assert found.dtype == torch.float32
    assert largest_relative(found, reconstruct_by_softmax(*(m.double() for m in maps), SIZES)) < 3e-6


def test_a_map_within_one_band_is_summed_once() -> None:
    (found,) = log_maps(torch.rand(1, 1, 16, 16) * (SPAN - 1))
    assert found.bands == [0]


def test_bands_without_pixels_are_skipped() -> None:
    stack = torch.zeros(1, 1, 16, 16)
    stack[..., 8:] = 100 * SPAN
    (found,) = log_maps(stack)
    assert found.bands == [0, 100]


def test_an_exported_graph_is_exact_to_128_and_finite_beyond() -> None:
    sample = tuple(t.float() for t in random_maps(16, 20, batch=1))

    def run(*maps: Tensor) -> Tensor:
        return reconstruct(*maps, SIZES)

    with pytest.warns(DeprecationWarning, match="torch.jit.trace"):
        traced = torch.jit.trace(run, sample)
    irradiance, log_importance, fusion = (t.float() for t in random_maps(23, 18))
    within = stretched(log_importance, 127.0)
    expected = reconstruct_by_softmax(irradiance, within, fusion, SIZES)
    torch.testing.assert_close(traced(irradiance, within, fusion), expected, rtol=1e-5, atol=1e-6)
    beyond = RANGES["left +1000, right -1000"](log_importance)
    found = traced(irradiance, beyond, fusion)
    assert found.isfinite().all()
    clear = slice(9 + 6, None)  # windows that hold nothing but pixels below the range average equally
    equal = reconstruct_by_softmax(irradiance, torch.zeros_like(beyond), fusion, SIZES)
    torch.testing.assert_close(found[..., clear], equal[..., clear])


def test_a_wrong_number_of_maps_is_refused() -> None:
    maps = random_maps(16, 16)
    with pytest.raises(ValueError, match="2 kernel sizes need as many importance maps"):
        reconstruct(*maps, (3, 5))


def test_an_even_kernel_is_refused() -> None:
    maps = random_maps(16, 16)
    with pytest.raises(ValueError, match="odd and positive"):
        reconstruct(*maps, (3, 5, 7, 9, 11, 12))


@pytest.mark.parametrize("recorded", [False, True])
def test_maps_of_a_small_range_are_summed_to_a_few_roundings(
    recorded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = [t[:, :2] if i else t for i, t in enumerate(t.float() for t in random_maps(40, 50))]
    monkeypatch.setattr(sharing, "exporting", lambda: recorded)
    expected = reconstruct_by_softmax(*(t.double() for t in maps), (3, 5))
    error = (reconstruct(*maps, (3, 5)).double() - expected).abs() / expected
    assert error.max() < 6e-7
