"""KP equals its literal transcription; sizes of its three forms, options, rows of logits, learning."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch

from models import KP
from models.kp import PRESETS
from models.ops import streaming
from tests.models.behaviour import assert_bfloat16_stays_near_float32, losses_of
from tests.models.frames import largest_relative, noisy_edges, random_buffers
from tests.models.plain_kp import plain_kp, plain_logits, unfold_gather
from trainer.losses import SMAPE

pytestmark = pytest.mark.usefixtures("one_thread")


def count(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


@pytest.mark.parametrize(
    ("preset", "training", "deployed"),
    [("KP", 115_150, 82_250), ("KP-1", 87_710, 62_650), ("KP-2", 49_490, 35_350)],
)
def test_parameter_counts_of_the_three_forms(preset: str, training: int, deployed: int) -> None:
    network = KP(**PRESETS[preset])
    assert count(network) == training
    assert count(network.deploy()) == deployed
    assert count(KP(**PRESETS[preset], branches=False)) == deployed


@pytest.mark.parametrize(("preset", "halo"), [("KP", 12), ("KP-1", 6), ("KP-2", 10)])
def test_the_halo_is_that_of_the_convolutions_or_of_the_kernel(preset: str, halo: int) -> None:
    assert KP(**PRESETS[preset]).halo == halo


def test_kp_without_arguments_is_the_first_form() -> None:
    assert count(KP()) == count(KP(**PRESETS["KP"]))
    assert KP().kernel_size == 13


@pytest.mark.parametrize(("layers", "size"), [(2, 13), (4, 5)])
def test_it_equals_the_literal_transcription(layers: int, size: int) -> None:
    torch.manual_seed(1)
    network = KP(layers, size, width=6).double()
    buffers = {name: image.double() for name, image in random_buffers(2, 9, 8).items()}
    expected = plain_kp(network.state_dict(), buffers, size)
    with torch.no_grad():
        assert largest_relative(network(buffers).color, expected) < 1e-12
        torch.testing.assert_close(network.predict(buffers), plain_logits(network.state_dict(), buffers))


@pytest.mark.parametrize("preset", PRESETS)
def test_its_three_forms_equal_unfold_in_values_and_gradients_of_every_weight(preset: str) -> None:
    torch.manual_seed(2)
    network = KP(**PRESETS[preset]).double()
    buffers = {name: image.double() for name, image in random_buffers(2, 16, 19).items()}
    state = {name: value.detach().clone().requires_grad_() for name, value in network.state_dict().items()}
    filtered = unfold_gather(
        buffers["irradiance"], plain_logits(state, buffers), PRESETS[preset]["kernel_size"]
    )
    expected, found = filtered * buffers["albedo"], network(buffers).color
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-12)
    weights = torch.rand_like(found)
    plain = torch.autograd.grad((expected * weights).sum(), list(state.values()))
    ours = torch.autograd.grad((found * weights).sum(), list(network.parameters()))
    for one, other in zip(ours, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("rows", [1, 7, 100])
def test_rows_of_logits_in_inference_equal_the_training_form(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(3)
    network, buffers = KP(), random_buffers(2, 24, 17)
    expected = network(buffers).color.detach()
    monkeypatch.setattr(streaming, "_CHUNK", rows * 2 * 169 * 17)
    for form in (network.eval(), network.deploy()):
        with torch.no_grad():
            assert largest_relative(form(buffers).color, expected) < 1e-5


@pytest.mark.parametrize(
    ("activation", "bias", "batch_norm", "branches"),
    itertools.product(["leaky_relu", "relu"], [False, True], [False, True], [False, True]),
)
def test_every_option_deploys_to_the_same_image(
    activation: Any, bias: bool, batch_norm: bool, branches: bool
) -> None:
    torch.manual_seed(3)
    network = KP(3, 5, 8, activation, bias, batch_norm, branches)
    buffers = random_buffers(2, 18, 16)
    with torch.no_grad():
        network(buffers)  # running statistics
        network.eval()
        found = network.deploy()(buffers).color
        assert largest_relative(found, network(buffers).color) < 1e-5


def test_relu_and_leaky_relu_are_different_networks() -> None:
    torch.manual_seed(0)
    leaky, relu = KP(3, 5), KP(3, 5, activation="relu")
    relu.load_state_dict(leaky.state_dict())
    buffers = random_buffers(1, 16, 16)
    assert largest_relative(relu(buffers).color, leaky(buffers).color) > 1e-5


def test_exposure_and_depth_range_reach_the_network() -> None:
    network, buffers = KP(2, 5), random_buffers(1, 20, 20)
    plain = network(buffers).color
    for number in ({"exposure": torch.tensor([4.0])}, {"depth_range": torch.tensor([[0.0, 30.0]])}):
        assert largest_relative(network({**buffers, **number}).color, plain) > 1e-4


def test_bfloat16_stays_near_float32() -> None:
    torch.manual_seed(4)
    assert_bfloat16_stays_near_float32(KP().eval(), random_buffers(1, 32, 32))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_form_learns_to_filter_along_edges(preset: str) -> None:
    torch.manual_seed(5)
    network, loss = KP(**PRESETS[preset]), SMAPE()
    buffers, reference = noisy_edges(2, 32, 32)
    noisy = loss(buffers["irradiance"] * buffers["albedo"], reference).item()
    losses = losses_of(network, lambda: loss(network(buffers).color, reference), 30, clip=1.0)
    assert losses[-1] < 0.6 * min(losses[0], noisy)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 1}, "at least 2 layers"),
        ({"width": 0}, "width 1, got 6 and 0"),
        ({"kernel_size": 4}, "kernel_size must be odd and positive, got 4"),
        ({"activation": "gelu"}, "unknown activation"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KP(**options)
