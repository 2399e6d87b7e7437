"""MR-KP equals its literal transcription in both presets; its sizes, options and reach."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from models import MRKP
from models.mrkp import PRESETS
from tests.models.frames import largest_relative, random_buffers
from tests.models.plain_mrkp import plain_mrkp

pytestmark = pytest.mark.usefixtures("one_thread")

SWITCHES: dict[str, Any] = {
    "kernels": "relu",
    "color": "irradiance",
    "alpha": "relu",
    "raw_level": True,
    "upsampling": "linear",
}
"""What changes the image, as the preset meng has it."""


def count(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def doubles(batch: int, height: int, width: int) -> dict[str, Tensor]:
    return {name: image.double() for name, image in random_buffers(batch, height, width).items()}


def lively(network: MRKP, reach: float = 0.4, seed: int = 1) -> MRKP:
    """The network in float64 with large parameters, biases too."""
    torch.manual_seed(seed)
    network = network.double()
    for parameter in network.parameters():
        torch.nn.init.uniform_(parameter, -reach, reach)
    return network


@pytest.mark.parametrize("preset", PRESETS)
def test_both_presets_have_the_parameters_of_the_authors_code(preset: str) -> None:
    network = MRKP(**PRESETS[preset])
    assert count(network) == count(network.deploy()) == 341_838
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert [shapes[f"unet.encoder.{i}.weight"] for i in range(5)] == [(48, 10, 3, 3), *[(48, 48, 3, 3)] * 4]
    assert [shapes[f"unet.decoder.{i}.weight"] for i in range(5)] == [(48, 48, 3, 3), *[(96, 48, 3, 3)] * 4]
    assert [shapes[f"unet.heads.{i}.weight"] for i in range(3)] == [(26, 96, 3, 3)] * 3
    assert len(shapes) == 2 * 13


def test_a_preset_is_the_sum_of_its_options_and_an_option_that_is_given_has_precedence() -> None:
    def options(network: MRKP) -> dict[str, Any]:
        return {name: getattr(network, name) for name in PRESETS["meng"]}

    assert options(MRKP()) == options(MRKP("wskp")) == options(MRKP(**PRESETS["wskp"])) == PRESETS["wskp"]
    assert options(MRKP("meng")) == options(MRKP(**PRESETS["meng"])) == PRESETS["meng"]
    assert options(MRKP("meng", raw_level=False)) == {**PRESETS["meng"], "raw_level": False}
    assert {**PRESETS["wskp"], **SWITCHES, "compare": "gamma"} == PRESETS["meng"]


def test_weights_are_uniform_after_glorot_and_biases_0() -> None:
    for name, value in MRKP().state_dict().items():
        if name.endswith("bias"):
            assert not value.any(), name
        else:
            bound = (6 / (9 * (value.shape[0] + value.shape[1]))) ** 0.5
            assert 0.98 * bound < value.abs().max() <= bound, name


@pytest.mark.parametrize(("preset", "halo"), [("wskp", 63), ("meng", 95)])
def test_the_published_form_has_a_grid_of_32_and_this_halo(preset: Any, halo: int) -> None:
    network = MRKP(preset)
    assert (network.multiple, network.halo) == (32, halo)


@pytest.mark.parametrize("raw_level", [False, True])
@pytest.mark.parametrize("upsampling", ["nearest", "linear"])
@pytest.mark.parametrize(
    ("levels", "resolutions", "size"), [(1, 1, 3), (1, 1, 13), (2, 2, 1), (2, 1, 5), (3, 3, 7), (3, 2, 13)]
)
def test_the_halo_is_the_reach_for_every_choice_of_levels(
    levels: int, resolutions: int, size: int, upsampling: Any, raw_level: bool
) -> None:
    network = MRKP(
        kernel_size=size,
        width=2,
        levels=levels,
        resolutions=resolutions,
        upsampling=upsampling,
        raw_level=raw_level,
    ).double()
    for parameter in network.parameters():  # positive, so that nothing is cut off and nothing cancels
        torch.nn.init.uniform_(parameter, 0.01, 0.1)
    side = network.multiple
    before = -(-(network.halo + 2) // side) * side
    buffers = doubles(1, 2 * before + side, 2 * before + side)
    buffers["depth_range"] = torch.tensor([[0.0, 6.0]], dtype=torch.float64)
    image = buffers["irradiance"].requires_grad_()
    core = slice(before, before + side)
    network(buffers).color[..., core, core].square().sum().backward()
    assert image.grad is not None
    rows = (image.grad[0] != 0).any(0).any(1).nonzero()
    assert max(before - int(rows.min()), int(rows.max()) - (before + side - 1)) == network.halo


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("levels", "resolutions", "size"), [(2, 2, 5), (3, 3, 3), (2, 1, 3)])
def test_it_equals_the_literal_transcription(preset: Any, levels: int, resolutions: int, size: int) -> None:
    network = lively(MRKP(preset, kernel_size=size, width=4, levels=levels, resolutions=resolutions))
    buffers = doubles(2, 16, 8)
    buffers["irradiance"][:, 1, ::3, ::2] = 0.0
    with torch.no_grad():
        found = network(buffers).color
        expected = plain_mrkp(network.state_dict(), buffers, preset, levels, resolutions, size)
    assert largest_relative(found, expected.clamp_min(0)) < 1e-11


@pytest.mark.parametrize("preset", PRESETS)
def test_its_published_size_equals_the_literal_transcription(preset: Any) -> None:
    network, buffers = lively(MRKP(preset), 0.08), doubles(1, 32, 32)
    with torch.no_grad():
        found = network(buffers).color
        expected = plain_mrkp(network.state_dict(), buffers, preset)
    assert found.min() < found.max()
    assert largest_relative(found, expected.clamp_min(0)) < 1e-10


@pytest.mark.parametrize("preset", PRESETS)
def test_gradients_equal_those_of_the_literal_transcription(preset: Any) -> None:
    network = lively(MRKP(preset, kernel_size=3, width=3, levels=2, resolutions=2))
    buffers, weights = doubles(1, 8, 8), torch.rand(1, 3, 8, 8, dtype=torch.float64)
    loss = (network(buffers).color * weights).sum()
    found = torch.autograd.grad(loss, list(network.parameters()))
    state = {name: value.clone().requires_grad_() for name, value in network.state_dict().items()}
    literal = plain_mrkp(state, buffers, preset, 2, 2, 3).clamp_min(0)
    expected = torch.autograd.grad((literal * weights).sum(), list(state.values()))
    for one, other in zip(found, expected, strict=True):
        assert largest_relative(one, other) < 1e-9


@pytest.mark.parametrize("name", SWITCHES)
def test_every_switch_changes_the_image_and_no_parameter(name: str) -> None:
    plain, buffers = lively(MRKP(width=4)), doubles(1, 32, 32)
    other = MRKP(width=4, **{name: SWITCHES[name]}).double()
    other.load_state_dict(plain.state_dict())
    with torch.no_grad():
        assert largest_relative(other(buffers).color, plain(buffers).color) > 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "fan"}, "preset 'fan'; expected one of wskp, meng"),
        ({"kernels": "exp"}, "kernels 'exp'; expected one of softmax, relu"),
        ({"color": "aces"}, "color 'aces'; expected one of gamma, filmic, irradiance"),
        ({"alpha": "tanh"}, "alpha 'tanh'; expected one of sigmoid, relu"),
        ({"raw_level": "yes"}, "raw_level 'yes'; expected one of False, True"),
        ({"upsampling": "cubic"}, "upsampling 'cubic'; expected one of nearest, linear"),
        ({"compare": "log"}, "compare 'log'; expected one of radiance, gamma"),
        ({"kernel_size": 4}, "kernel_size must be odd and positive, got 4"),
        ({"resolutions": 6}, "got 48, 6 and 5"),
        ({"resolutions": 0}, "got 48, 0 and 5"),
        ({"width": 0}, "got 0, 3 and 5"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MRKP(**options)
