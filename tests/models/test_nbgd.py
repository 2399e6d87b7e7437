"""NBGD equals its literal transcription; its options; wrong and extreme inputs; it learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models import NBGD
from models.denoiser import select
from models.ops.outliers import replace_outliers
from tests.models.behaviour import losses_of
from tests.models.frames import largest_relative, random_buffers, split_buffers
from tests.models.plain_nbgd import filmic, gamma, outputs, plain_nbgd
from trainer.export import SUFFIXES, export, load_artifact
from trainer.losses import L1

pytestmark = pytest.mark.usefixtures("one_thread")


def made(seed: int = 0, **options: Any) -> NBGD:
    """A network in float64 with biases and steep outputs."""
    torch.manual_seed(seed)
    network = NBGD(**options).double().eval()
    for parameter in network.parameters():
        if parameter.dim() == 1:
            torch.nn.init.uniform_(parameter, -0.2, 0.2)
    with torch.no_grad():
        network.convolutions[-1].weight.mul_(4)  # type: ignore[union-attr, operator]
    return network


def frame(batch: int = 2, height: int = 32, width: int = 48, seed: int = 0) -> dict[str, Tensor]:
    return {name: value.double() for name, value in random_buffers(batch, height, width, seed).items()}


def parameters(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


@pytest.mark.parametrize(("layers", "count", "halo"), [(2, 7_525, 28), (7, 29_425, 38)])
def test_published_parameter_counts_and_what_the_output_depends_on(
    layers: int, count: int, halo: int
) -> None:
    network = NBGD(layers)
    assert parameters(network) == parameters(network.deploy()) == count
    assert network.halo == halo
    assert NBGD(layers, outliers=True).halo == halo + 1


def test_published_layer_shapes_and_initialisation() -> None:
    state = NBGD(7).state_dict()
    shapes = [tuple(value.shape) for name, value in state.items() if name.endswith("weight")]
    assert shapes == [(20, 10, 5, 5), *((5, 20 + 5 * j, 5, 5) for j in range(5)), (5, 45, 5, 5)]
    assert all(not value.any() for name, value in state.items() if name.endswith("bias"))
    bound = (6 / (25 * (10 + 20))) ** 0.5
    assert 0.99 * bound < state["convolutions.0.weight"].abs().max() <= bound


@pytest.mark.parametrize("curve", ["gamma", "filmic"])
@pytest.mark.parametrize("layers", [2, 7])
def test_it_equals_the_literal_transcription(layers: int, curve: str) -> None:
    network, buffers = made(layers=layers, curve=curve), frame()
    expected = plain_nbgd(network.state_dict(), buffers, curve).clamp_min(0)
    with torch.no_grad():
        found = network(buffers).color
    assert largest_relative(found, expected) < 1e-11


@pytest.mark.parametrize("layers", [2, 7])
def test_gradients_equal_those_of_the_literal_transcription(layers: int) -> None:
    network, buffers = made(layers=layers, gradient_limit=None), frame(1, 16, 32)
    weights = torch.rand(1, 3, 16, 32, dtype=torch.float64)
    loss = (network(buffers).color * weights).sum()
    found = torch.autograd.grad(loss, list(network.parameters()))
    state = {name: value.clone().requires_grad_() for name, value in network.state_dict().items()}
    literal = (plain_nbgd(state, buffers).clamp_min(0) * weights).sum()
    expected = torch.autograd.grad(literal, list(state.values()))
    for one, other in zip(found, expected, strict=True):
        assert largest_relative(one, other) < 1e-9


def test_the_network_sees_and_predicts_what_the_authors_describe() -> None:
    network, buffers = made(), frame()
    depth = buffers["depth"]
    low, high = depth.amin((1, 2, 3), keepdim=True), depth.amax((1, 2, 3), keepdim=True)
    color = gamma(buffers["irradiance"] * buffers["albedo"])
    features = [color, buffers["albedo"], buffers["normal"] * 0.5 + 0.5, (depth - low) / (high - low)]
    made_of = outputs(network.state_dict(), torch.cat(features, 1))
    guides = network.predict(buffers)
    torch.testing.assert_close(guides.levels, 255 * made_of[:, :3])
    torch.testing.assert_close(guides.blend[:, :2], made_of[:, 3:])
    torch.testing.assert_close(guides.blend.sum(1), torch.ones_like(guides.blend[:, 0]))
    assert guides.levels.amax() - guides.levels.amin() > 60


def biased(logits: tuple[float, float], **options: Any) -> NBGD:
    """A network whose blend weights do not depend on the pixel."""
    network = made(**options)
    last = network.convolutions[-1]
    with torch.no_grad():
        last.weight[3:] = 0.0  # type: ignore[index, operator]
        last.bias[3:] = torch.tensor(logits, dtype=torch.float64)  # type: ignore[index, operator]
    return network


def test_the_third_blend_weight_may_be_negative_and_what_it_makes_negative_is_cut_off() -> None:
    network, buffers = biased((9.0, 9.0)), frame()
    weights = network.predict(buffers).blend[0, :, 0, 0]
    assert weights[2] < -0.99
    buffers["irradiance"] = buffers["irradiance"] ** 2  # so that grids differ much
    literal = plain_nbgd(network.state_dict(), buffers)
    assert (literal < 0).any()
    assert largest_relative(network(buffers).color, literal.clamp_min(0)) < 1e-11


def test_softmax_blend_weighs_with_the_softmax_of_both_logits_and_0() -> None:
    network, buffers = biased((0.7, -1.3), softmax_blend=True), frame()
    expected = torch.tensor([0.7, -1.3, 0.0], dtype=torch.float64).softmax(0)
    found = network.predict(buffers).blend
    torch.testing.assert_close(found, expected[:, None, None].expand_as(found))
    assert parameters(network) == 7_525
    only = biased((60.0, 0.0), softmax_blend=True)  # the finest grid alone
    sigmoid = biased((60.0, -60.0))
    assert largest_relative(only(buffers).color, sigmoid(buffers).color) < 1e-12


def test_outliers_are_replaced_before_anything_else() -> None:
    network, buffers = made(outliers=True), frame()
    buffers["albedo"] = torch.full_like(buffers["albedo"], 0.5)
    buffers["normal"] = torch.zeros_like(buffers["normal"])
    buffers["irradiance"] = 1 + 0.1 * buffers["irradiance"]
    buffers["irradiance"][..., 7, 9] = 1e4
    exposure = torch.tensor([0.5, 2.0], dtype=torch.float64)
    clean = replace_outliers(
        buffers["irradiance"], buffers["albedo"], buffers["normal"], exposure.reshape(2, 1, 1, 1)
    )
    assert clean[..., 7, 9].max() < 10
    plain = made()
    expected = plain({**buffers, "irradiance": clean, "exposure": exposure}).color
    assert largest_relative(network({**buffers, "exposure": exposure}).color, expected) < 1e-12
    assert largest_relative(plain({**buffers, "exposure": exposure}).color, expected) > 0.1


def test_gradients_are_limited_as_in_the_authors_code_unless_told_otherwise() -> None:
    buffers = frame(1, 16, 16)
    buffers["irradiance"] = buffers["irradiance"] * 1e4

    def slope(**options: Any) -> Tensor:
        network = made(**options)
        network(buffers).color.sum().backward()
        gradient = network.convolutions[-1].weight.grad
        assert isinstance(gradient, Tensor)
        return gradient

    whole, published = slope(gradient_limit=None), slope()
    assert torch.equal(slope(gradient_limit=1e30), whole)
    assert torch.equal(slope(gradient_limit=100.0), published)
    assert not torch.equal(published[:3], whole[:3])
    nothing = slope(gradient_limit=1e-300)
    assert not nothing[:3].any()  # guides
    assert torch.equal(nothing[3:], whole[3:])  # blend weights


def test_sizes_that_are_no_multiples_of_16_are_padded_by_repeating_the_border() -> None:
    network, buffers = made(), frame(1, 17, 39)
    padded = {name: F.pad(image, (0, 9, 0, 15), mode="replicate") for name, image in buffers.items()}
    expected = network(padded).color[..., :17, :39]
    found = network(buffers).color
    assert torch.equal(found, expected)
    assert found.is_contiguous()
    levels = network.predict(buffers).levels
    assert torch.equal(levels, network.predict(padded).levels[..., :17, :39])


def test_depth_is_scaled_by_the_range_of_the_whole_frame_where_it_is_given() -> None:
    network, buffers = made(), frame(2, 48, 48)
    crop = {name: image[..., 16:32, 16:32] for name, image in buffers.items()}
    whole = network._features(network._clean({**crop, **network.measure(buffers)}))
    expected = network._features(network._clean(buffers))[..., 16:32, 16:32]
    torch.testing.assert_close(whole, expected)
    flat = network._features(network._clean({**crop, "depth": torch.full_like(crop["depth"], 3.0)}))
    assert (flat[:, 9] == 0).all()


@pytest.mark.parametrize("factor", [1 / 512, 32.0])
def test_radiance_in_other_units_with_matching_exposure_gives_the_same_image(factor: float) -> None:
    network, buffers = made(), frame()
    exposure = torch.tensor([1.0, 0.5], dtype=torch.float64)
    expected = network({**buffers, "exposure": exposure}).color
    scaled = {**buffers, "irradiance": buffers["irradiance"] * factor}
    found = network({**scaled, "exposure": exposure / factor}).color
    assert largest_relative(found / factor, expected) < 1e-11
    assert largest_relative(network(buffers).color, expected) > 1e-4


@pytest.mark.parametrize(("curve", "literal"), [("gamma", gamma), ("filmic", filmic)])
def test_training_compares_exposed_radiance_after_the_tone_curve(curve: Any, literal: Any) -> None:
    torch.manual_seed(0)
    network, batch = NBGD(curve=curve), split_buffers(2, 16, 32)
    exposure = torch.tensor([0.5, 2.0])
    scale = exposure.reshape(2, 1, 1, 1)
    pair = network.training_pairs({**batch, "exposure": exposure})["color"]
    color = network({**select(network, batch), "exposure": exposure}).color
    torch.testing.assert_close(pair.output, literal(color * scale))
    torch.testing.assert_close(pair.target, literal(batch["reference"] * scale))


@pytest.mark.parametrize("broken", [float("nan"), float("inf"), -float("inf"), -5.0])
def test_broken_values_in_any_buffer_stay_where_they_are(broken: float) -> None:
    torch.manual_seed(0)
    network = NBGD(outliers=True)
    for name in network.inputs:
        buffers = random_buffers(1, 32, 32)
        buffers[name][..., 3, 4] = broken
        color = network(buffers).color
        assert color.isfinite().all(), name
        assert (color >= 0).all(), name
        color.clamp_max(1e4).mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_guides_are_exact_under_mixed_precision_to_what_the_first_layers_round() -> None:
    torch.manual_seed(0)
    network, buffers = NBGD(), random_buffers(1, 32, 32)
    exact = network.predict(buffers).levels
    with torch.autocast("cpu", torch.bfloat16):
        found = network.predict(buffers).levels
    assert found.dtype == torch.float32
    steps = (found * 2).frac() != 0  # bfloat16 has no halves of levels above 128
    assert steps.double().mean() > 0.9
    assert (found - exact).abs().max() < 2


def stripes() -> dict[str, Tensor]:
    """Stripes 6 pixels wide, dark and bright, with normals of their own, in noisy light."""
    torch.manual_seed(0)
    sign = torch.where(torch.arange(48) % 12 < 6, 1.0, -1.0).expand(1, 1, 48, 48)
    albedo, light = torch.full((1, 3, 48, 48), 0.5), (0.55 + 0.45 * sign).expand(1, 3, 48, 48)
    normal = torch.cat([0.8 * sign, torch.zeros_like(sign), torch.full_like(sign, 0.6)], 1)
    noisy = -light * torch.log1p(-torch.rand_like(light))
    depth = torch.ones_like(sign)
    return {
        "irradiance": noisy,
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
        "reference": light * albedo,
    }


@pytest.mark.parametrize("layers", [2, 7])
def test_it_learns_to_keep_stripes_apart_in_noisy_light(layers: int) -> None:
    batch = stripes()
    torch.manual_seed(0)
    network, loss = NBGD(layers), L1()

    def compared() -> Tensor:
        pair = network.training_pairs(batch)["color"]
        return loss(pair.output, pair.target)

    losses = losses_of(network, compared, 40, clip=None)
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("format", sorted(SUFFIXES))
def test_seven_layers_with_all_options_are_exported_for_every_size(tmp_path: Path, format: Any) -> None:
    torch.manual_seed(1)
    network = NBGD(7, curve="filmic", softmax_blend=True, outliers=True)
    path = tmp_path / f"net{SUFFIXES[format]}"
    export(network, path, format)
    buffers = random_buffers(2, 35, 50)
    with torch.inference_mode():
        expected = network.eval()(buffers).color
    found = load_artifact(path)(buffers).color
    assert largest_relative(found, expected) < 1e-4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 1}, "at least 2 layers"),
        ({"width": 0}, "width 1, got 2 and 0"),
        ({"curve": "srgb"}, "expected 'gamma' or 'filmic'"),
        ({"gradient_limit": 0.0}, "gradient_limit must be positive or null"),
        ({"gradient_limit": float("nan")}, "gradient_limit must be positive or null"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NBGD(**options)
