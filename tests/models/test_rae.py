from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models import RAE
from models.denoiser import State
from tests.models.frames import largest_relative, random_buffers
from tests.models.plain_rae import plain_rae

pytestmark = pytest.mark.usefixtures("one_thread")


def sequence(count: int, batch: int = 1, height: int = 32, width: int = 64) -> list[dict[str, Tensor]]:
    bounds = torch.tensor([[0.5, 7.0]]).repeat(batch, 1)
    numbers = {"exposure": torch.linspace(0.5, 2.0, batch), "depth_range": bounds}
    return [{**random_buffers(batch, height, width, seed), **numbers} for seed in range(count)]


def denoised(network: RAE, frames: list[dict[str, Tensor]], state: State | None = None) -> list[Tensor]:
    colors = []
    for frame in frames:
        color, state, _ = network(frame, state)
        colors.append(color)
    return colors


@pytest.fixture
def network() -> RAE:
    torch.manual_seed(3)
    return RAE().eval()


@torch.no_grad()
def test_the_network_has_the_published_layers(network: RAE) -> None:
    assert sum(p.numel() for p in network.parameters()) == 1_951_935
    widths = [stage.after.out_channels for stage in network.encoder]
    assert widths == [32, 43, 57, 76, 101, 101]
    state = network(sequence(1, height=64)[0]).state
    assert [tuple(state[f"hidden{k}"].shape) for k in range(6)] == [
        (1, channels, 64 >> k, 64 >> k) for k, channels in enumerate(widths)
    ]


@torch.no_grad()
def test_three_frames_equal_the_transcription(network: RAE) -> None:
    frames = [{name: image.double() for name, image in frame.items()} for frame in sequence(3, batch=2)]
    expected = plain_rae(network, frames)
    for found, wanted in zip(denoised(network.double(), frames), expected, strict=True):
        assert largest_relative(found, wanted) < 1e-9


@torch.no_grad()
def test_a_frame_depends_on_the_frames_before(network: RAE) -> None:
    first, second = sequence(2)
    state = network(first).state
    continued, alone = network(second, state).color, network(second).color
    assert (continued - alone).abs().max() > 1e-3 * alone.abs().max()
    zeros = {name: torch.zeros_like(maps) for name, maps in state.items()}
    assert torch.equal(network(second, zeros).color, alone)


def test_gradients_flow_through_time(network: RAE) -> None:
    first, second = sequence(2)
    first["irradiance"].requires_grad_()
    network(second, network(first).state).color.sum().backward()
    assert first["irradiance"].grad is not None
    assert first["irradiance"].grad.abs().max() > 0


def test_what_is_compared_is_the_fifth_root_of_exposed_irradiance(network: RAE) -> None:
    frame = sequence(1)[0]
    frame["albedo"][..., :8] = 0.0
    pair, result = network.next_pair({**frame, "reference": frame["irradiance"] * frame["albedo"]}, None)
    exposed = frame["irradiance"] * frame["exposure"].reshape(-1, 1, 1, 1)
    torch.testing.assert_close(pair.target[..., 8:], exposed[..., 8:] ** 0.2, rtol=1e-4, atol=1e-5)
    assert (pair.target[..., :8] == 0).all()
    color = pair.output.clamp_min(0) ** 5 / frame["exposure"].reshape(-1, 1, 1, 1) * frame["albedo"]
    torch.testing.assert_close(result.color, color)


def test_a_black_frame_has_finite_gradients(network: RAE) -> None:
    frame = {name: torch.zeros_like(image) for name, image in sequence(1)[0].items()}
    pair, _ = network.next_pair({**frame, "reference": frame["irradiance"]}, None)
    (pair.output - pair.target).abs().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_other_features_are_read() -> None:
    network = RAE(features=("normal", "depth", "roughness"))
    assert network.inputs == ("irradiance", "albedo", "normal", "depth", "roughness")
    assert network.enter.in_channels == 8


def test_a_state_of_another_size_is_refused(network: RAE) -> None:
    small, large = sequence(1)[0], sequence(1, height=64)[0]
    state = network(small).state
    with pytest.raises(ValueError, match="another batch or size"):
        network(large, state)
    with pytest.raises(ValueError, match="another batch or size"):
        network(small, {"hidden0": state["hidden0"]})


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="stages and tail"):
        RAE(stages=())
    with pytest.raises(ValueError, match="stages and tail"):
        RAE(tail=(8,))
    with pytest.raises(ValueError, match="gloss"):
        RAE(features=("gloss",))
