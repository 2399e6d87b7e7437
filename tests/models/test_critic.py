"""The critic: the published sizes and names, and what its gradient penalty asks of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from models.critic import Critic

PUBLISHED = Path(__file__).parents[2] / ".." / "shared" / "published" / "statedict_afgsa.txt"
CHANNELS = (3, 64, 64, 128, 128, 256, 256, 512, 512, 512, 512)


def count(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def slopes(critic: Critic, images: Tensor) -> Tensor:
    """Norms of the scores' gradients, (B,), differentiable."""
    images = images.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(critic(images).sum(), images, create_graph=True)
    return gradient.flatten(1).norm(dim=1)


def test_the_critic_has_the_published_number_of_parameters() -> None:
    assert count(Critic()) == 14_502_281


def test_entries_and_shapes_are_the_authors() -> None:
    expected: dict[str, tuple[int, ...]] = {}
    for i in range(10):
        kernel, wide = 4 if i % 2 else 3, (CHANNELS[i + 1],)
        expected[f"features.{i}.0.weight"] = (CHANNELS[i + 1], CHANNELS[i], kernel, kernel)
        expected[f"features.{i}.0.bias"] = wide
        if i:
            for name in ("weight", "bias", "running_mean", "running_var"):
                expected[f"features.{i}.1.{name}"] = wide
            expected[f"features.{i}.1.num_batches_tracked"] = ()
    expected |= {"classifier.0.weight": (100, 8192), "classifier.0.bias": (100,)}
    expected |= {"classifier.2.weight": (1, 100), "classifier.2.bias": (1,)}
    assert {name: tuple(value.shape) for name, value in Critic().state_dict().items()} == expected


@pytest.mark.shared
@pytest.mark.skipif(not PUBLISHED.exists(), reason="needs ../shared")
def test_entries_and_shapes_are_those_of_the_authors_list() -> None:
    listed = PUBLISHED.read_text().split("## DISCRIMINATOR")[1]
    found = re.findall(r"^(\S+)\t\(([\d, ]*)\)", listed, re.MULTILINE)
    expected = {name: tuple(int(n) for n in shape.split(",") if n.strip()) for name, shape in found}
    assert {name: tuple(value.shape) for name, value in Critic().state_dict().items()} == expected


def test_layer_by_layer_the_image_is_halved_and_normalised_but_in_the_first() -> None:
    critic, sizes = Critic(64, width=4), []
    for layer in critic.features:
        layer.register_forward_hook(lambda _module, _given, made: sizes.append(tuple(made.shape[1:])))
    critic(torch.rand(2, 3, 64, 64))
    widths, sides = (4, 4, 8, 8, 16, 16, 32, 32, 32, 32), (64, 32, 32, 16, 16, 8, 8, 4, 4, 2)
    assert sizes == [(w, s, s) for w, s in zip(widths, sides, strict=True)]
    normalised = [any(isinstance(m, nn.BatchNorm2d) for m in layer.modules()) for layer in critic.features]
    assert normalised == [False] + [True] * 9


def test_the_score_is_what_the_layers_say_one_after_the_other() -> None:
    torch.manual_seed(1)
    critic, image = Critic(32, "none", width=2).double(), torch.rand(2, 3, 32, 32, dtype=torch.float64)
    state, maps = critic.state_dict(), image
    for i in range(10):
        weight, bias = state[f"features.{i}.0.weight"], state[f"features.{i}.0.bias"]
        maps = nn.functional.conv2d(maps, weight, bias, stride=1 + i % 2, padding=1)
        maps = torch.where(maps > 0, maps, 0.2 * maps)
    hidden = maps.reshape(2, -1) @ state["classifier.0.weight"].T + state["classifier.0.bias"]
    hidden = torch.where(hidden > 0, hidden, 0.2 * hidden)
    expected = hidden @ state["classifier.2.weight"].T + state["classifier.2.bias"]
    torch.testing.assert_close(critic(image), expected[:, 0], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("size", [64, 96, 192])
def test_other_sizes_are_scored(size: int) -> None:
    scores = Critic(size, width=2)(torch.rand(2, 3, size, size))
    assert scores.shape == (2,)
    assert scores.isfinite().all()


@pytest.mark.parametrize("shape", [(2, 3, 64, 96), (2, 4, 64, 64), (3, 64, 64), (1, 3, 128, 128)])
def test_an_image_of_another_size_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"built for images \(B, 3, 64, 64\).*crop size"):
        Critic(64, width=2)(torch.rand(shape))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 100}, "multiple of 32"),
        ({"size": 0}, "multiple of 32"),
        ({"size": 32, "norm": "instance"}, "size of at least 64"),
        ({"width": 0}, "width"),
        ({"norm": "layer"}, "'batch', 'instance' or 'none'"),
        ({"init": "xavier"}, "'default' or 'kaiming'"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Critic(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("norm", ["batch", "instance", "none"])
@pytest.mark.parametrize("autocast", [False, True])
def test_the_penalty_reaches_the_weights(norm: str, autocast: bool) -> None:
    torch.manual_seed(0)
    critic, images = Critic(64, norm, width=4), torch.rand(3, 3, 64, 64)  # type: ignore[arg-type]
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
        assert critic(images).dtype == torch.float32
        (slopes(critic, images) - 1).square().mean().backward()
    gradients = {name: p.grad for name, p in critic.named_parameters()}
    for name, gradient in gradients.items():
        if name.endswith("weight"):
            assert gradient is not None
            assert gradient.isfinite().all()
            assert gradient.abs().max() > 0


def test_autocast_changes_nothing() -> None:
    critic, images = Critic(64, "none", width=4), torch.rand(2, 3, 64, 64)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = critic(images)
    assert torch.equal(found, critic(images))
    assert torch.equal(critic(images.bfloat16()), critic(images.bfloat16().float()))


@pytest.mark.parametrize("norm", ["instance", "none"])
@pytest.mark.parametrize("training", [False, True])
def test_an_image_is_scored_alone(norm: str, training: bool) -> None:
    critic = Critic(64, norm, width=4).double().train(training)  # type: ignore[arg-type]
    images = torch.rand(3, 3, 64, 64, dtype=torch.float64)
    torch.testing.assert_close(critic(images)[:1], critic(images[:1]), rtol=1e-10, atol=0)


def test_batch_normalisation_couples_the_images_of_a_batch() -> None:
    torch.manual_seed(0)
    critic, images = Critic(64, width=4).double(), torch.rand(3, 3, 64, 64, dtype=torch.float64)
    assert (critic(images)[:1] - critic(images[[0, 2, 2]])[:1]).abs() > 1e-6


def test_kaiming_starts_with_the_spread_of_fan_in_and_no_biases() -> None:
    torch.manual_seed(0)
    critic = Critic(64, width=16, init="kaiming")
    for name, parameter in critic.named_parameters():
        if ".1." in name:
            continue  # batch normalisation starts at 1 and 0
        if name.endswith("bias"):
            assert (parameter == 0).all()
        elif parameter.numel() > 10_000:
            fan_in = parameter[0].numel()
            assert abs(parameter.std().item() / (2 / fan_in) ** 0.5 - 1) < 0.03
