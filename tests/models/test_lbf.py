"""LBF is its transcription in float64, learns, and keeps what it promises."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from data.buffers import buffer
from models.denoiser import Buffers, select
from models.lbf import LBF
from models.ops.secondary_features import NUMBERS
from models.tiling import denoise_tiled
from tests.models import plain_lbf
from tests.models.behaviour import assert_bfloat16_stays_near_float32, losses_of
from tests.models.classical.test_nlm_forms import as_rows, noisy_buffers
from tests.models.frames import largest_relative
from tests.models.plain_nlm import Array
from trainer.losses import RelativeL2

pytestmark = pytest.mark.usefixtures("one_thread")

NAMES = ("normal", "albedo", "depth")
SMALL: dict[str, Any] = {"window": 3, "prefilter_window": 2, "prefilter_patch": 1, "spike_window": 4}
SMALL |= {"variance_spikes": 5.0}  # a window of 9x9 pixels has none beyond 8.9 deviations
NUMBERS_SMALL = plain_lbf.Numbers(window=3, prefilter=(2, 1, 2), spike_window=4, variance_limit=5.0)


def doubled(buffers: Buffers) -> dict[str, Tensor]:
    return {name: image.double() for name, image in buffers.items()}


def spiked(height: int, width: int) -> dict[str, Tensor]:
    """Noisy buffers with a spike of the colour's variance and one of its colour."""
    found = noisy_buffers(1, height, width)
    found["color_variance"][0, 1, height // 2, width // 3] *= 3000
    for part in "ab":
        found[f"color_{part}"][0, :, height // 3, width // 2] += 40.0
    return found


def random_network(method: LBF, seed: int = 3) -> plain_lbf.Network:
    """Give a network weights that use all of the input, and return them."""
    generator = torch.Generator().manual_seed(seed)
    method.eval()  # so that it does not measure its own

    def noise(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    hidden, seen = method.network.first.weight.shape[:2]
    method.network.first.weight.data.copy_(0.7 * noise(hidden, seen, 1, 1))
    method.network.last.weight.data.copy_(1.5 * noise(*method.network.last.weight.shape))
    assert method.network.last.bias is not None
    method.network.last.bias.data.copy_(torch.linspace(-4, 1, len(method.network.last.bias)))
    method.network.mean.copy_(0.3 * noise(seen))
    method.network.deviation.copy_(0.3 + noise(seen).abs())
    layers = [
        (layer.weight.detach()[..., 0, 0].double().numpy(), layer.bias.detach().double().numpy())
        for layer in (method.network.first, method.network.last)
        if layer.bias is not None
    ]
    mean, deviation = method.network.mean.double().numpy(), method.network.deviation.double().numpy()
    return plain_lbf.Network(layers[0], layers[1], mean, deviation)


def parts(buffers: Buffers, name: str, unit: float = 1.0) -> plain_lbf.Noisy:
    a, b, variance = (as_rows(buffers[f"{name}_{part}"]) for part in ("a", "b", "variance"))
    return plain_lbf.Noisy(a / unit, b / unit, variance / unit**2)


def transcription(
    method: LBF, buffers: Buffers, numbers: plain_lbf.Numbers, exposure: float = 1.0
) -> plain_lbf.Steps:
    network = random_network(method)
    farthest = float(parts(buffers, "depth").mean.max()) if "depth" in method.features else 1.0
    features = [parts(buffers, name, farthest if name == "depth" else 1.0) for name in method.features]
    return plain_lbf.lbf(parts(buffers, "color", 1 / exposure), features, network, numbers)


def scales_of(method: LBF, aux: Any) -> Array:
    return np.concatenate(
        [as_rows(aux[f"scale_{name}"].detach()) for name in ("image", *method.features)], -1
    )


@pytest.mark.parametrize("size", [(13, 12), (1, 11), (9, 1)])
def test_the_result_and_the_predictions_equal_the_transcription(size: tuple[int, int]) -> None:
    given = doubled(spiked(*size))
    method = LBF(NAMES, **SMALL, aux=True).double()
    expected = transcription(method, given, NUMBERS_SMALL)
    found = method(given)
    assert np.abs(scales_of(method, found.aux) - expected.scales).max() < 1e-9
    assert largest_relative(found.color, torch.from_numpy(expected.color).movedim(-1, 0)[None]) < 1e-9
    assert expected.scales.max() > 10 * expected.scales.min()


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        ({"sampling": "random"}, {"scaled": False}),
        ({"variance_spikes": None}, {"variance_limit": None}),
        ({"output_spikes": None, "color_factor": 1 / 98}, {"output_limit": None, "factor": 1 / 98}),
        ({"least_variance": 0.01, "samples_per_pixel": 4}, {"least": 0.01, "spp": 4.0}),
    ],
)
def test_every_option_is_the_transcriptions(options: dict[str, Any], numbers: dict[str, Any]) -> None:
    given = doubled(spiked(10, 11))
    method = LBF(("albedo",), **{**SMALL, **options}).double()
    expected = transcription(method, given, plain_lbf.Numbers(**{**vars(NUMBERS_SMALL), **numbers}))
    usual = transcription(method, given, NUMBERS_SMALL)
    assert np.abs(as_rows(method(given).color.detach()) - expected.color).max() < 1e-9
    assert np.abs(usual.color - expected.color).max() > 1e-6


@pytest.mark.slow
def test_published_radii_equal_the_transcription_where_windows_are_larger_than_the_image() -> None:
    given = doubled(spiked(20, 17))
    method = LBF(NAMES).double()
    expected = transcription(method, given, plain_lbf.Numbers())
    assert np.abs(as_rows(method(given).color.detach()) - expected.color).max() < 1e-9


def test_float32_gives_the_result_of_float64() -> None:
    given = spiked(24, 70)
    method = LBF(NAMES, **SMALL)
    random_network(method)
    with torch.no_grad():
        assert largest_relative(method(given).color, method.double()(doubled(given)).color) < 1e-4


def test_the_papers_groups_make_36_features_and_436_parameters() -> None:
    method = LBF()
    assert method.features == ("position", "normal", "albedo", "second_albedo", "visibility")
    assert NUMBERS * len(method.features) + 1 == 36
    assert method.network.first.weight.shape[:2] == (10, 36)
    assert method.network.last.weight.shape[:2] == (6, 10)
    assert sum(parameter.numel() for parameter in method.parameters()) == 436
    assert method.rule.groups == (3, 3, 3, 3, 1)
    assert method.rule.window == 27


def test_distances_are_those_of_the_frame_whatever_its_unit() -> None:
    given = noisy_buffers(1, 17, 19)
    other = dict(given)
    for part, power in (("_a", 1), ("_b", 1), ("_variance", 2)):
        other[f"depth{part}"] = given[f"depth{part}"] * 1000.0**power
    method = LBF(NAMES, **SMALL)
    random_network(method)
    with torch.no_grad():
        assert largest_relative(method(other).color, method(given).color) < 1e-4


def training_batch(size: int = 18, count: int = 2) -> dict[str, Tensor]:
    """Noisy halves of bright and dark blocks that the albedo tells apart, and the truth."""
    generator = torch.Generator().manual_seed(1)
    blocks = (torch.arange(size)[:, None] // 6 + torch.arange(size) // 6) % 2
    truth = (0.2 + 0.6 * blocks).expand(count, 3, size, size)
    a, b = (truth + 0.3 * torch.randn(truth.shape, generator=generator) for _ in "ab")
    found = {"color_a": a, "color_b": b, "color_variance": torch.full_like(a, 0.045), "reference": truth}
    for part in ("a", "b"):
        found[f"albedo_{part}"] = truth + 0.02 * torch.randn(truth.shape, generator=generator)
    found["albedo_variance"] = torch.full_like(truth, 2e-4)
    return {**found, "exposure": torch.ones(count)}


def test_it_learns_through_the_filter() -> None:
    torch.manual_seed(0)
    method, batch = LBF(("albedo",), **SMALL), training_batch()
    loss = RelativeL2()
    inputs = select(method, batch)
    losses = losses_of(method, lambda: loss(method(inputs).color, batch["reference"]), 40, None)
    noisy = loss(0.5 * (batch["color_a"] + batch["color_b"]), batch["reference"]).item()
    assert losses[-1] < 0.9 * losses[0]
    assert losses[-1] < 0.1 * noisy


def test_what_is_missing_and_what_makes_it_is_named() -> None:
    given = noisy_buffers(1, 16, 16)
    del given["albedo_variance"]
    with pytest.raises(ValueError, match=r"missing: albedo_variance.*`trainer render stills` writes"):
        LBF(("albedo",))(given)


def test_second_hits_that_are_missing_and_what_makes_them_are_named() -> None:
    given = {name: torch.rand(1, buffer(name).channels, 16, 16) for name in LBF().inputs}
    for missing in ("second_albedo_a", "position_variance"):
        lacking = {name: image for name, image in given.items() if name != missing}
        with pytest.raises(ValueError, match=f"missing: {missing}.*trainer render stills --second-hit"):
            LBF()(lacking)


def test_halves_or_a_mean_and_a_variance_do_where_the_others_are_missing() -> None:
    method = LBF(("albedo", "depth"), **SMALL)
    random_network(method)
    available = {"color_a", "color_b", "albedo", "albedo_variance", "depth_a", "depth_b", "depth_variance"}
    found = method.instead(available)
    assert found is not None
    other, reasons = found
    assert set(other.inputs) <= available
    assert len(reasons) == 2
    given = noisy_buffers(1, 16, 18)
    color = other({name: given[name] for name in available}).color
    assert color.isfinite().all()
    assert torch.equal(dict(other.named_parameters())["network.first.weight"], method.network.first.weight)
    assert method.instead({"color", "albedo"}) is None


def damaged(value: float) -> dict[str, Tensor]:
    given = noisy_buffers(1, 18, 17)
    for name in list(given):
        if name.endswith(("_a", "_b", "_variance")):
            given[name][..., 3:5, 6] = value
    return given


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -1.0])
def test_damaged_frames_give_finite_images_and_gradients(value: float) -> None:
    method = LBF(NAMES, **SMALL)
    method.eval()
    color = method(damaged(value)).color
    assert color.isfinite().all()
    color.clamp_max(1e4).mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in method.parameters())


def test_a_firefly_stays_where_it_is_and_its_spike_is_taken_out() -> None:
    given = noisy_buffers(1, 20, 20)
    for part in "ab":
        given[f"color_{part}"][0, :, 9, 9] = 6e4
    given["color_variance"][0, :, 9, 9] = 1e-3
    with torch.no_grad():
        kept = LBF(NAMES, **SMALL, output_spikes=None, sampling="random")(given).color
        calm = LBF(NAMES, **SMALL, sampling="random")(given).color
    assert kept[0, :, 9, 9].min() > 1e4
    assert calm.max() < 100


def test_layers_are_the_predictions_and_the_filtered_features_in_their_units() -> None:
    given = noisy_buffers(1, 16, 18)
    with torch.no_grad():
        aux = LBF(NAMES, **SMALL, aux=True)(given).aux
    assert aux is not None
    assert list(aux) == ["scale_image", *(f"scale_{name}" for name in NAMES), *NAMES]
    for name in NAMES:
        mean = 0.5 * (given[f"{name}_a"] + given[f"{name}_b"])
        assert aux[name].shape == mean.shape
        assert (aux[name] - mean).abs().mean() < 0.3 * mean.abs().mean()
    assert LBF(NAMES, **SMALL)(given).aux is None


def test_bfloat16_stays_near_float32() -> None:
    given = noisy_buffers(1, 20, 21)
    assert_bfloat16_stays_near_float32(LBF(NAMES, **SMALL), given)


def test_positions_are_read_whole() -> None:
    method = LBF(("position",), feature_noise="none", **SMALL)
    assert method.whole
    given = {**noisy_buffers(1, 20, 40), "position": torch.rand(1, 3, 20, 40) * 50}
    with torch.no_grad():
        assert torch.equal(denoise_tiled(method, given, tile=16), method(given).color)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"window": 0}, "window radius >= 1"),
        ({"prefilter_patch": -1}, "window radius >= 1, patch and smoothing radii >= 0"),
        ({"sampling": "sobol"}, "LBF: sampling must be"),
        ({"least_variance": 0.0}, "least_variance and samples_per_pixel above 0"),
        ({"hidden": 0}, "hidden and spike_window of at least 1"),
        ({"output_spikes": 0.0}, "LBF: output_spikes must be above 0"),
        ({"color_noise": "none"}, "LBF: color_noise must be one of measured, halves, variance, estimated"),
        ({"features": ("color",)}, "LBF: features must be different buffers beside color"),
    ],
)
def test_arguments_that_cannot_be_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LBF(**{"features": ("albedo",), **arguments})
