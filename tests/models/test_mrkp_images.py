"""MR-KP: what it sees and predicts, light of every kind, training, export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from models import MRKP
from models.denoiser import select
from models.mrkp import PRESETS
from models.ops.resolutions import blended
from models.ops.ten_channels import BRIGHTEST
from models.ops.tonemap import filmic, gamma
from models.tiling import denoise_tiled
from tests.models.behaviour import assert_bfloat16_stays_near_float32, losses_of
from tests.models.frames import largest_relative, noisy_edges, random_buffers, split_buffers
from tests.models.test_mrkp import doubles, lively
from trainer.export import SUFFIXES, export, load_artifact
from trainer.losses import L1, SMAPE

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(("color", "curve"), [("gamma", gamma), ("filmic", filmic)])
def test_the_network_sees_exposed_color_through_its_curve(color: Any, curve: Any) -> None:
    network, buffers = MRKP(color=color, width=4), random_buffers(1, 32, 32)
    seen = maps_seen(network, {**buffers, "exposure": torch.tensor([0.5])})
    torch.testing.assert_close(seen[:, :3], curve(0.5 * buffers["irradiance"] * buffers["albedo"]))
    torch.testing.assert_close(seen[:, 3:6], buffers["albedo"])


def test_raw_irradiance_is_seen_exposed_and_ends_where_half_precision_does() -> None:
    network, buffers = MRKP("meng", width=4), random_buffers(1, 32, 32)
    buffers["irradiance"][..., 3, 4] = 1e9
    seen = maps_seen(network, {**buffers, "exposure": torch.tensor([0.5])})
    torch.testing.assert_close(seen[:, :3], (0.5 * buffers["irradiance"]).clamp_max(65504.0))
    assert seen[0, 0, 3, 4] == BRIGHTEST


def maps_seen(network: MRKP, buffers: dict[str, Tensor]) -> Tensor:
    """The ten channels that a network reads."""
    seen: list[Tensor] = []
    network.unet.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    network(buffers)
    return seen[0]


@pytest.mark.parametrize("preset", PRESETS)
def test_predictions_are_of_full_half_and_quarter_resolution_and_in_range(preset: Any) -> None:
    levels = lively(MRKP(preset, width=4)).predict(doubles(1, 32, 64))
    assert [tuple(level.kernels.shape) for level in levels] == [
        (1, 25, 32, 64),
        (1, 25, 16, 32),
        (1, 25, 8, 16),
    ]
    assert (levels[-1].alpha is None) == (preset == "wskp")
    alphas = [level.alpha for level in levels if level.alpha is not None]
    assert [tuple(alpha.shape[2:]) for alpha in alphas] == [(32, 64), (16, 32), (8, 16)][: len(alphas)]
    if preset == "wskp":
        assert all(((alpha > 0) & (alpha < 1)).all() for alpha in alphas)
        assert (levels[0].kernels < 0).any()
    else:
        assert all((alpha >= 0).all() for alpha in alphas)
        assert alphas[0].max() > 1
        assert all((level.kernels >= 0).all() for level in levels)


def test_pixels_whose_relu_kernels_are_all_0_are_black() -> None:
    network, buffers = MRKP("meng", width=4), random_buffers(1, 32, 32)
    with torch.no_grad():
        for head in network.unet.heads:
            head.bias[:25] = -1e6  # type: ignore[index, operator]
            head.bias[25] = -1e6  # type: ignore[index, operator]
        assert not network(buffers).color.any()
        buffers["irradiance"].zero_()
        assert not MRKP("meng", width=4)(buffers).color.any()


def test_a_constant_image_stays_constant_where_relu_kernels_are_not_dead() -> None:
    torch.manual_seed(2)
    network, buffers = MRKP("meng", width=8), random_buffers(1, 33, 40)
    buffers["irradiance"].fill_(300.0)
    with torch.no_grad():
        for head in network.unet.heads:
            head.bias.fill_(1.0)  # type: ignore[operator, union-attr]
            head.weight.mul_(1e-3)  # type: ignore[operator, union-attr]
        found = network(buffers).color / buffers["albedo"]
    torch.testing.assert_close(found, torch.full_like(found, 300.0), rtol=1e-5, atol=0)


def test_negative_radiance_of_equation_7_becomes_black(monkeypatch: pytest.MonkeyPatch) -> None:
    network, buffers = lively(MRKP("meng", width=4)), doubles(1, 32, 32)
    buffers["irradiance"][..., ::9, ::7] = 1e4
    combined: list[Tensor] = []

    def recorded(*arguments: Any) -> Tensor:
        combined.append(blended(*arguments))
        return combined[-1]

    monkeypatch.setattr("models.mrkp.blended", recorded)
    with torch.no_grad():
        found = network(buffers).color
    assert len(combined) == 3
    assert (combined[-1] < 0).any()
    assert torch.equal(found, combined[-1].clamp_min(0.0) * buffers["albedo"])


@pytest.mark.parametrize("preset", PRESETS)
def test_sides_that_are_no_multiples_are_padded_by_repeating(preset: Any) -> None:
    network, buffers = lively(MRKP(preset, width=4)), doubles(1, 27, 40)
    whole = {n: torch.nn.functional.pad(b, (0, 24, 0, 5), mode="replicate") for n, b in buffers.items()}
    with torch.no_grad():
        found, expected = network(buffers).color, network(whole).color[..., :27, :40]
    assert largest_relative(found, expected) < 1e-12


def test_meng_compares_exposed_radiance_after_gamma_and_wskp_radiance() -> None:
    torch.manual_seed(0)
    batch, exposure = split_buffers(2, 32, 32), torch.tensor([0.5, 2.0])
    scale, batch["exposure"] = exposure.reshape(2, 1, 1, 1), exposure
    for preset, curve in (("meng", gamma), ("wskp", torch.Tensor.float)):
        network = MRKP(preset, width=4)  # type: ignore[arg-type]
        pair = network.training_pairs(batch)["color"]
        color = network(select(network, batch)).color
        torch.testing.assert_close(pair.output, curve(color * scale))
        torch.testing.assert_close(pair.target, curve(batch["reference"] * scale))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("case", ["black", "bright", "fireflies", "one firefly in black"])
def test_extreme_light_stays_finite_with_finite_gradients_without_a_tone_curve(
    case: str, precision: str
) -> None:
    torch.manual_seed(3)
    network, buffers = MRKP("meng"), random_buffers(1, 32, 32)
    light = buffers["irradiance"]
    if case == "fireflies":
        light[..., ::7, ::5] = 65504.0
    else:
        light.fill_(65504.0 if case == "bright" else 0.0)
    if case == "one firefly in black":
        light[..., 9, 11] = 1e9
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        color = network(buffers).color
    assert color.dtype == torch.float32
    assert color.isfinite().all()
    color.mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


@pytest.mark.parametrize("factor", [1 / 512, 32.0])
@pytest.mark.parametrize("preset", PRESETS)
def test_radiance_in_other_units_with_matching_exposure_gives_the_same_image(
    preset: Any, factor: float
) -> None:
    network, buffers = lively(MRKP(preset, width=4)), doubles(2, 32, 32)
    exposure = torch.tensor([1.0, 0.5], dtype=torch.float64)
    expected = network({**buffers, "exposure": exposure}).color
    scaled = {**buffers, "irradiance": buffers["irradiance"] * factor}
    found = network({**scaled, "exposure": exposure / factor}).color
    assert largest_relative(found / factor, expected) < 1e-11
    assert largest_relative(network(buffers).color, expected) > 1e-4


def test_tiles_of_the_preset_meng_equal_the_whole_image() -> None:
    network = lively(MRKP("meng", width=4, levels=3), 0.2)
    buffers = doubles(1, 61, 75)
    with torch.no_grad():
        expected = network(buffers).color
        found = denoise_tiled(network, buffers, tile=24)
    assert largest_relative(found, expected) < 1e-11


@pytest.mark.parametrize("preset", PRESETS)
def test_bfloat16_stays_near_float32(preset: Any) -> None:
    torch.manual_seed(4)
    assert_bfloat16_stays_near_float32(MRKP(preset, width=16).eval(), random_buffers(1, 32, 32))


def test_wskp_learns_to_filter_along_edges() -> None:
    torch.manual_seed(5)
    network, loss = MRKP(), SMAPE()
    buffers, reference = noisy_edges(2, 32, 32)
    noisy = loss(buffers["irradiance"] * buffers["albedo"], reference).item()
    losses = losses_of(network, lambda: loss(network(buffers).color, reference), 25, clip=1.0)
    assert losses[-1] < 0.6 * min(losses[0], noisy)


def test_meng_learns_to_filter_along_edges() -> None:
    torch.manual_seed(5)
    network, loss = MRKP("meng"), L1()
    buffers, reference = noisy_edges(2, 32, 32)
    noisy = loss(gamma(buffers["irradiance"] * buffers["albedo"]), gamma(reference)).item()

    def compared() -> Tensor:
        pair = network.training_pairs({**buffers, "reference": reference})["color"]
        return loss(pair.output, pair.target)

    losses = losses_of(network, compared, 25, clip=1.0)
    assert losses[-1] < 0.6 * min(losses[0], noisy)


@pytest.mark.parametrize("format", sorted(SUFFIXES))
def test_the_preset_meng_is_exported_for_every_size(tmp_path: Path, format: Any) -> None:
    torch.manual_seed(1)
    network = MRKP("meng", width=16)
    path = tmp_path / f"net{SUFFIXES[format]}"
    export(network, path, format)
    buffers = random_buffers(2, 35, 50)
    with torch.inference_mode():
        expected = network.eval()(buffers).color
    found = load_artifact(path)(buffers).color
    assert largest_relative(found, expected) < 1e-4
