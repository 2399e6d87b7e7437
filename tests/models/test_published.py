"""The authors' weights in our network give their network's output.

`authors_network` is written from the description of their code: every branch convolved on its own, exp
without a shift, windows summed by dense convolutions with ones.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models import WSKP
from models.published import load_published
from tests.models.frames import largest_relative, random_buffers

SHARED = Path(__file__).parents[3] / "shared"
CHECKPOINTS = ["classroom", "livingroom", "san-miguel", "sponza", "sponza-glossy", "sponza-moving-light"]


def random_weights(layers: int, seed: int = 0) -> dict[str, Tensor]:
    """Weights in the authors' names, scaled so that log-importance stays in their range."""
    generator = torch.Generator().manual_seed(seed)
    names = [f"conv{i}" for i in range(1, layers)] + ["conv_final"]
    weights = {}
    for index, name in enumerate(names):
        inputs, outputs = (10 if index == 0 else 14), (12 if name == "conv_final" else 14)
        for size in (5, 3, 1):
            scale = 1.0 / (inputs * size * size) ** 0.5
            shape = (outputs, inputs, size, size)
            weights[f"{name}_{size}.weight"] = torch.randn(shape, generator=generator) * scale
    return weights


def authors_network(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
    irradiance, albedo, depth = buffers["irradiance"], buffers["albedo"], buffers["depth"]
    color = (irradiance * albedo).clamp_min(0).pow(0.454545).clamp(0, 1)
    depth = (depth - depth.min()) / (depth.max() - depth.min())
    maps = torch.cat([color, albedo, buffers["normal"] * 0.5 + 0.5, depth], 1)
    layers = len({re.split("_[135]", name)[0] for name in weights})
    for layer in range(1, layers):
        summed = sum(F.conv2d(maps, weights[f"conv{layer}_{k}.weight"], padding=k // 2) for k in (5, 3, 1))
        assert isinstance(summed, Tensor)
        maps = F.leaky_relu(summed + maps if layer > 1 else summed, 0.1)
    final = sum(F.conv2d(maps, weights[f"conv_final_{k}.weight"], padding=k // 2) for k in (5, 3, 1))
    assert isinstance(final, Tensor)
    importance, fusion = final[:, :6].exp(), final[:, 6:].softmax(1)
    total = torch.zeros_like(irradiance)
    for index, size in enumerate((3, 5, 7, 9, 11, 13)):
        ones = torch.ones(1, 1, size, size).to(final)
        one = importance[:, index : index + 1]
        below = F.conv2d(one, ones, padding=size // 2)
        above = [F.conv2d(one * irradiance[:, c : c + 1], ones, padding=size // 2) for c in range(3)]
        total = total + fusion[:, index : index + 1] * torch.cat(above, 1) / below
    return albedo * total


def double(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.double() for name, tensor in tensors.items()}


@pytest.mark.parametrize("layers", [6, 3])
def test_weights_in_the_authors_names_give_the_authors_output(layers: int) -> None:
    weights, buffers = random_weights(layers), random_buffers(1, 37, 53)
    network = load_published("wskp", {"model_state_dict": weights, "optimizer_state_dict": {}})
    assert len(network.blocks) == layers
    expected = authors_network(double(weights), double(buffers))
    with torch.no_grad():
        assert largest_relative(network.double()(double(buffers)).color, expected) < 1e-12
        assert largest_relative(network.float()(buffers).color, expected) < 1e-5
        assert largest_relative(network.deploy()(buffers).color, expected) < 1e-5


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.is_dir(), reason="the development data is not there")
@pytest.mark.parametrize("name", CHECKPOINTS)
@pytest.mark.parametrize("frame", ["random", "classroom", "sponza"])
def test_published_checkpoints_give_the_authors_output_on(frame: str, name: str) -> None:
    checkpoint = torch.load(SHARED / f"published/wskp/{name}.pt", weights_only=True, map_location="cpu")
    buffers = random_buffers(1, 64, 80) if frame == "random" else real_frame(frame)
    network = load_published("wskp", checkpoint)
    weights = checkpoint["model_state_dict"]
    expected = authors_network(double(weights), double(buffers))
    with torch.no_grad():
        found = network(buffers).color
        assert largest_relative(network.double()(double(buffers)).color, expected) < 1e-12
        assert largest_relative(found, authors_network(weights, buffers)) < 1e-5
    assert largest_relative(found, expected) < 1e-5


def real_frame(scene: str) -> dict[str, Tensor]:
    """One noisy frame of 1 spp, exposed, as BMFR would have it."""
    exr = pytest.importorskip("OpenEXR")
    with exr.File(str(SHARED / f"dataset/video/{scene}/f003_input.exr"), separate_channels=True) as file:
        channels = {k: np.asarray(v.pixels, np.float32) for k, v in file.channels().items()}

    def stack(name: str, letters: str) -> Tensor:
        return torch.from_numpy(np.stack([channels[f"{name}.{x}"] for x in letters]))[None, :, :96, :128]

    albedo = (stack("albedo", "RGB") + stack("specular", "RGB")).clamp(0.01, 1)
    color = stack("color", "RGB")
    return {
        "irradiance": color / albedo / color.mean(),
        "albedo": albedo,
        "normal": stack("normal", "XYZ"),
        "depth": stack("depth", "Z"),
    }


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.is_dir(), reason="the development data is not there")
def test_the_classroom_checkpoint_has_the_published_fingerprint() -> None:
    checkpoint = torch.load(SHARED / "published/wskp/classroom.pt", weights_only=True, map_location="cpu")
    weight = next(load_published("wskp", checkpoint).parameters())
    assert float(weight.detach().sum()) == pytest.approx(-14.440933, abs=1e-4)


def test_the_inner_dict_is_accepted_too() -> None:
    weights = random_weights(6)
    inner, outer = load_published("wskp", weights), load_published("wskp", {"model_state_dict": weights})
    assert all(torch.equal(a, b) for a, b in zip(inner.parameters(), outer.parameters(), strict=True))
    assert not inner.training


def test_a_missing_entry_is_named() -> None:
    weights = random_weights(6)
    del weights["conv3_1.weight"]
    with pytest.raises(ValueError, match=r"missing conv3_1\.weight"):
        load_published("wskp", weights)


def test_an_unexpected_entry_is_named() -> None:
    with pytest.raises(ValueError, match=r"unexpected conv2_7\.weight"):
        load_published("wskp", {**random_weights(6), "conv2_7.weight": torch.zeros(14, 14, 7, 7)})


def test_an_entry_of_another_shape_is_named() -> None:
    with pytest.raises(
        ValueError, match=r"conv2_3\.weight has shape \(14, 14, 5, 5\), expected \(14, 14, 3, 3\)"
    ):
        load_published("wskp", {**random_weights(6), "conv2_3.weight": torch.zeros(14, 14, 5, 5)})


def test_weights_of_another_network_are_refused() -> None:
    with pytest.raises(ValueError, match="not the authors' entries"):
        load_published("wskp", WSKP().state_dict())


def test_an_unknown_method_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'afgsa'; known: wskp"):
        load_published("afgsa", {})
