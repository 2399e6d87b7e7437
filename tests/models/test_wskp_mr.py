"""Multi-resolution WSKP equals its literal transcription; sizes, options, learning."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from models import MultiResolutionWSKP
from models.blocks.average_unet import AverageUNet
from models.ops.resolutions import blended
from models.ops.tonemap import filmic, gamma
from tests.models.behaviour import assert_bfloat16_stays_near_float32, losses_of
from tests.models.frames import largest_relative, noisy_edges, random_buffers
from tests.models.plain_wskp_mr import plain_heads, plain_wskp_mr, spread_out
from trainer.losses import SMAPE

pytestmark = pytest.mark.usefixtures("one_thread")


def count(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def doubles(batch: int, height: int, width: int) -> dict[str, torch.Tensor]:
    return {name: image.double() for name, image in random_buffers(batch, height, width).items()}


def test_it_has_the_parameters_of_mr_kp_with_smaller_heads() -> None:
    heads = 3 * (96 * 9 * 26 + 26)
    smaller = 2 * (96 * 9 * 5 + 5) + (96 * 9 * 4 + 4)
    assert count(AverageUNet(10, 48, 5, (26, 26, 26))) == 341_838
    assert count(MultiResolutionWSKP()) == 286_478 == 341_838 - heads + smaller


def test_the_published_form_has_a_grid_of_32_and_a_halo_of_95() -> None:
    network = MultiResolutionWSKP()
    assert (network.multiple, network.halo) == (32, 95)


@pytest.mark.parametrize(
    ("levels", "resolutions", "size"), [(1, 1, 3), (1, 1, 13), (2, 1, 1), (3, 3, 7), (3, 2, 13), (4, 3, 5)]
)
def test_the_halo_is_the_reach_for_every_choice_of_levels(levels: int, resolutions: int, size: int) -> None:
    network = MultiResolutionWSKP(2, levels, resolutions, (size,)).double()
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


@pytest.mark.parametrize(("levels", "resolutions", "sizes"), [(2, 2, (3, 5)), (3, 3, (3,)), (2, 1, (1, 7))])
def test_it_equals_the_literal_transcription(levels: int, resolutions: int, sizes: tuple[int, ...]) -> None:
    torch.manual_seed(1)
    network, buffers = MultiResolutionWSKP(4, levels, resolutions, sizes).double(), doubles(2, 16, 8)
    for parameter in network.parameters():
        torch.nn.init.uniform_(parameter, -0.4, 0.4)
    with torch.no_grad():
        found = network(buffers).color
        expected = plain_wskp_mr(network.state_dict(), buffers, levels, resolutions, sizes).clamp_min(0)
    assert largest_relative(found, expected) < 1e-12


def test_the_published_u_net_equals_convolutions_written_out() -> None:
    torch.manual_seed(2)
    unet = AverageUNet(10, 48, 5, (5, 5, 4)).double()
    image = torch.rand(1, 10, 32, 64, dtype=torch.float64)
    state = {f"unet.{name}": value for name, value in unet.state_dict().items()}
    with torch.no_grad():
        for found, expected in zip(unet(image), plain_heads(state, image, 5, 3), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-12)


def test_a_pixel_is_doubled_to_nine() -> None:
    maps, weight = torch.zeros(1, 1, 3, 3), torch.arange(1.0, 10.0).reshape(1, 1, 3, 3)
    maps[..., 1, 1] = 1.0
    found = spread_out(maps, weight, torch.zeros(1))[0, 0]
    assert torch.equal(found[1:4, 1:4], weight[0, 0])
    assert found.count_nonzero() == 9


def test_sides_that_are_no_multiples_are_padded_by_repeating() -> None:
    torch.manual_seed(3)
    network, buffers = MultiResolutionWSKP(8), random_buffers(1, 27, 40)
    whole = {n: torch.nn.functional.pad(b, (0, 24, 0, 5), mode="replicate") for n, b in buffers.items()}
    with torch.no_grad():
        found, expected = network(buffers).color, network(whole).color[..., :27, :40]
    assert largest_relative(found, expected) < 1e-6


def test_predictions_have_an_alpha_but_at_the_coarsest_resolution() -> None:
    levels = MultiResolutionWSKP(8).predict(random_buffers(1, 32, 64))
    assert [tuple(level.log_importance.shape) for level in levels] == [
        (1, 2, 32, 64),
        (1, 2, 16, 32),
        (1, 2, 8, 16),
    ]
    assert levels[-1].alpha is None
    for level in levels[:-1]:
        assert level.alpha is not None
        assert level.alpha.shape[1] == 1
        assert ((level.alpha > 0) & (level.alpha < 1)).all()


@pytest.mark.parametrize(("name", "curve"), [("filmic", filmic), ("gamma", gamma)])
def test_the_network_sees_exposed_color_through_its_curve(name: Any, curve: Any) -> None:
    network, buffers = MultiResolutionWSKP(8, curve=name), random_buffers(1, 32, 32)
    seen: list[torch.Tensor] = []
    network.unet.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    network({**buffers, "exposure": torch.tensor([0.5])})
    color = curve(0.5 * buffers["irradiance"] * buffers["albedo"])
    torch.testing.assert_close(seen[0][:, :3], color)
    torch.testing.assert_close(seen[0][:, 3:6], buffers["albedo"])


def test_negative_radiance_of_equation_7_becomes_black(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(3)
    network, buffers = MultiResolutionWSKP(8), random_buffers(1, 64, 64)
    buffers["irradiance"][..., ::9, ::7] = 1e4
    for parameter in network.parameters():
        torch.nn.init.uniform_(parameter, -0.4, 0.4)
    combined: list[torch.Tensor] = []

    def recorded(*images: torch.Tensor) -> torch.Tensor:
        combined.append(blended(*images))
        return combined[-1]

    monkeypatch.setattr("models.wskp_mr.blended", recorded)
    with torch.no_grad():
        found = network(buffers).color
    assert (combined[-1] < 0).any()
    assert torch.equal(found, combined[-1].clamp_min(0.0) * buffers["albedo"])


def test_bfloat16_stays_near_float32() -> None:
    torch.manual_seed(4)
    assert_bfloat16_stays_near_float32(MultiResolutionWSKP(16).eval(), random_buffers(1, 32, 32))


def test_it_learns_to_filter_along_edges() -> None:
    torch.manual_seed(5)
    network, loss = MultiResolutionWSKP(), SMAPE()
    buffers, reference = noisy_edges(2, 32, 32)
    noisy = loss(buffers["irradiance"] * buffers["albedo"], reference).item()
    losses = losses_of(network, lambda: loss(network(buffers).color, reference), 25, clip=1.0)
    assert losses[-1] < 0.6 * min(losses[0], noisy)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kernel_sizes": (3, 4)}, "kernel_sizes must be odd and positive"),
        ({"kernel_sizes": ()}, "kernel_sizes must be odd and positive"),
        ({"resolutions": 6}, "got 48, 6 and 5"),
        ({"resolutions": 0}, "got 48, 0 and 5"),
        ({"width": 0}, "got 0, 3 and 5"),
        ({"curve": "aces"}, "curve 'aces'; expected one of filmic, gamma"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MultiResolutionWSKP(**options)


def test_a_u_net_has_no_more_outputs_than_levels() -> None:
    with pytest.raises(ValueError, match="3 outputs need as many levels, got 2"):
        AverageUNet(10, 4, 2, (1, 1, 1))
