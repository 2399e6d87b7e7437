"""WSKP: sizes, preprocessing, options."""

from __future__ import annotations

import itertools

import pytest
import torch

from models import WSKP
from models.ops.tonemap import gamma
from tests.models.frames import largest_relative, random_buffers


def count(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


@pytest.mark.parametrize(("layers", "training", "deployed"), [(6, 38220, 27300), (3, 17640, 12600)])
def test_parameter_counts_are_the_published_ones(layers: int, training: int, deployed: int) -> None:
    network = WSKP(layers=layers)
    assert count(network) == training
    assert count(network.deploy()) == deployed


@pytest.mark.parametrize(("layers", "halo"), [(6, 18), (3, 12)])
def test_the_halo_is_two_pixels_per_layer_and_half_the_largest_window(layers: int, halo: int) -> None:
    assert WSKP(layers=layers).halo == halo


def test_the_network_sees_what_the_authors_feed_it() -> None:
    buffers = random_buffers(2, 16, 18)
    features = WSKP()._features(buffers)
    depth = buffers["depth"]
    low, high = depth.amin((1, 2, 3), keepdim=True), depth.amax((1, 2, 3), keepdim=True)
    expected = [
        gamma(buffers["irradiance"] * buffers["albedo"]),
        buffers["albedo"],
        buffers["normal"] * 0.5 + 0.5,
        (depth - low) / (high - low),
    ]
    torch.testing.assert_close(features, torch.cat(expected, 1))


def test_depth_is_scaled_by_the_range_of_the_whole_frame_where_it_is_given() -> None:
    buffers = random_buffers(2, 24, 24)
    network = WSKP()
    crop = {name: image[..., 4:20, 5:21] for name, image in buffers.items()}
    features = network._features({**crop, **network.measure(buffers)})
    torch.testing.assert_close(features, network._features(buffers)[..., 4:20, 5:21])


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_constant_depth_becomes_0(value: float) -> None:
    buffers = random_buffers(1, 16, 16)
    buffers["depth"] = torch.full_like(buffers["depth"], value)
    assert (WSKP()._features(buffers)[:, 9] == 0).all()


@pytest.mark.parametrize("factor", [1 / 512, 0.05, 32.0])
def test_radiance_in_other_units_with_matching_exposure_gives_the_same_image(factor: float) -> None:
    network, buffers = WSKP(), random_buffers(2, 20, 20)
    reference = network({**buffers, "exposure": torch.tensor([1.0, 0.5])}).color
    scaled = {**buffers, "irradiance": buffers["irradiance"] * factor}
    found = network({**scaled, "exposure": torch.tensor([1.0, 0.5]) / factor}).color
    assert largest_relative(found / factor, reference) < 1e-5


def test_exposure_changes_what_the_network_sees() -> None:
    network, buffers = WSKP(), random_buffers(1, 20, 20)
    bright = network({**buffers, "exposure": torch.tensor([4.0])}).color
    assert largest_relative(bright, network(buffers).color) > 1e-4


def test_absent_exposure_is_1() -> None:
    network, buffers = WSKP(), random_buffers(2, 16, 16)
    assert torch.equal(network(buffers).color, network({**buffers, "exposure": torch.ones(2)}).color)


@pytest.mark.parametrize(
    ("activation", "bias", "batch_norm", "branches"),
    itertools.product(["leaky_relu", "relu"], [False, True], [False, True], [False, True]),
)
def test_every_option_deploys_to_the_same_image(
    activation: str, bias: bool, batch_norm: bool, branches: bool
) -> None:
    torch.manual_seed(3)
    network = WSKP(
        layers=3, width=8, kernel_sizes=(3, 7), activation=activation,  # type: ignore[arg-type]
        bias=bias, batch_norm=batch_norm, branches=branches,
    )  # fmt: skip
    buffers = random_buffers(2, 18, 16)
    network(buffers)
    network.eval()
    assert largest_relative(network.deploy()(buffers).color, network(buffers).color) < 1e-5


def test_relu_and_leaky_relu_are_different_networks() -> None:
    torch.manual_seed(0)
    leaky, relu = WSKP(), WSKP(activation="relu")
    relu.load_state_dict(leaky.state_dict())
    buffers = random_buffers(1, 16, 16)
    assert largest_relative(relu(buffers).color, leaky(buffers).color) > 1e-5


def test_deploying_leaves_the_training_form_as_it_was() -> None:
    network = WSKP()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.deploy()
    assert network.training
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_fusion_weights_are_positive_and_sum_to_1() -> None:
    kernels = WSKP().predict(random_buffers(1, 16, 16))
    assert kernels.log_importance.shape == (1, 6, 16, 16)
    assert (kernels.fusion > 0).all()
    torch.testing.assert_close(kernels.fusion.sum(1), torch.ones(1, 16, 16))


def test_training_is_bit_reproducible() -> None:
    def train() -> list[torch.Tensor]:
        torch.manual_seed(5)
        network = WSKP(layers=3)
        optimizer = torch.optim.Adam(network.parameters(), 1e-3)
        for step in range(3):
            optimizer.zero_grad()
            network(random_buffers(4, 32, 32, seed=step)).color.abs().mean().backward()
            optimizer.step()
        return [p.detach().clone() for p in network.parameters()]

    assert all(torch.equal(one, other) for one, other in zip(train(), train(), strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 1}, "at least 2 layers"),
        ({"kernel_sizes": (3, 4)}, "odd and positive"),
        ({"kernel_sizes": ()}, "odd and positive"),
        ({"activation": "gelu"}, "unknown activation"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WSKP(**options)  # type: ignore[arg-type]
