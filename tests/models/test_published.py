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
from tests.models.frames import largest_relative, random_buffers, split_buffers
from tests.models.plain_afgsa import PlainAFGSA

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


def authors_afgsa(width: int = 16, blocks: int = 2) -> dict[str, Tensor]:
    """Random weights of AFGSA's generator in the authors' names."""
    torch.manual_seed(0)
    return PlainAFGSA(width, blocks, 2).state_dict()


def afgsa_entries() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the authors' generator, written down."""
    entries: dict[str, tuple[int, ...]] = {}

    def convolution(name: str, outputs: int, inputs: int, size: int) -> None:
        entries[f"{name}.weight"] = (outputs, inputs, size, size)
        entries[f"{name}.bias"] = (outputs,)

    for size in (1, 3, 5):
        convolution(f"conv{size}.0", 256, 3, size)
        convolution(f"conv_a{size}.0", 256, 7, size)
    convolution("conv_map.0", 256, 768, 1)
    convolution("conv_aenc1.0", 256, 768, 1)
    convolution("conv_aenc2.0", 256, 256, 1)
    for block in range(5):
        attention = f"transformer_blocks.{block}.attention"
        entries |= {f"{attention}.rel_h": (1, 14, 1, 32), f"{attention}.rel_w": (1, 1, 14, 32)}
        entries |= {f"{attention}.{letter}_conv.weight": (256, 256, 1, 1) for letter in "qkv"}
        convolution(f"{attention}.conv_map.0", 256, 512, 1)
        for layer in (0, 1):
            convolution(f"transformer_blocks.{block}.feed_forward.{layer}.0", 256, 256, 3)
    for layer, outputs in enumerate((256, 256, 3)):
        convolution(f"decoder.{layer}.0", outputs, 256, 3)
    return entries


def test_afgsa_takes_the_79_entries_of_the_authors() -> None:
    entries = afgsa_entries()
    assert len(entries) == 79
    assert entries == {name: tuple(t.shape) for name, t in PlainAFGSA().state_dict().items()}
    network = load_published("afgsa", {name: torch.full(shape, 0.5) for name, shape in entries.items()})
    assert all(bool((p == 0.5).all()) for p in network.parameters())
    assert sum(p.numel() for p in network.parameters()) == 9_282_691


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.is_dir(), reason="the development data is not there")
def test_afgsas_entries_are_those_of_the_authors_code() -> None:
    lines = (SHARED / "published/statedict_afgsa.txt").read_text().split("## DISCRIMINATOR")[0].splitlines()
    pairs = [line.split("\t") for line in lines if "\t" in line]
    shapes = {name: tuple(int(n) for n in re.findall(r"\d+", shape)) for name, shape in pairs}
    assert shapes == afgsa_entries()


@pytest.mark.parametrize("wrapper", [None, "model_state_dict", "state_dict", "model", "G"])
def test_afgsa_with_the_authors_weights_gives_their_output(wrapper: str | None) -> None:
    torch.manual_seed(4)
    plain = PlainAFGSA(16, 3, 2)
    weights = plain.state_dict()
    network = load_published("afgsa", weights if wrapper is None else {wrapper: weights})
    assert (len(network.blocks), network.halo, network.training) == (3, 29, False)
    buffers = split_buffers(2, 16, 24)
    depth = buffers["depth"] / buffers["depth"].amax((1, 2, 3), keepdim=True)
    aux = torch.cat([buffers["normal"] / 2 + 0.5, depth, buffers["albedo"]], 1)
    with torch.no_grad():
        log = plain(torch.log1p(buffers["color"]), aux)
        assert largest_relative(network.predict(buffers), log) < 1e-5
        assert largest_relative(network(buffers).color, torch.expm1(log).clamp_min(0)) < 1e-5


def test_names_that_parallel_training_prefixed_are_taken() -> None:
    weights = authors_afgsa()
    plain = load_published("afgsa", weights)
    prefixed = load_published("afgsa", {f"module.{name}": value for name, value in weights.items()})
    assert all(torch.equal(a, b) for a, b in zip(plain.parameters(), prefixed.parameters(), strict=True))


def test_a_missing_entry_of_afgsa_is_named() -> None:
    weights = authors_afgsa()
    del weights["transformer_blocks.1.attention.q_conv.weight"]
    with pytest.raises(ValueError, match=r"afgsa: missing transformer_blocks\.1\.attention\.q_conv\.weight"):
        load_published("afgsa", weights)


def test_an_unexpected_entry_of_afgsa_is_named() -> None:
    with pytest.raises(ValueError, match=r"afgsa: unexpected decoder\.3\.0\.weight"):
        load_published("afgsa", {**authors_afgsa(), "decoder.3.0.weight": torch.zeros(3)})


def test_an_entry_of_afgsa_of_another_shape_is_named() -> None:
    wrong = {**authors_afgsa(), "decoder.0.0.bias": torch.zeros(17)}
    with pytest.raises(ValueError, match=r"decoder\.0\.0\.bias has shape \(17,\), expected \(16,\)"):
        load_published("afgsa", wrong)


@pytest.mark.parametrize("shape", [(), (0,), (1, 14, 1, 0), (1, 3, 7, 4)], ids=str)
def test_any_entry_of_afgsa_of_a_wrong_shape_is_an_error_that_says_so(shape: tuple[int, ...]) -> None:
    weights = authors_afgsa(8, 1)
    for name in weights:
        with pytest.raises(ValueError, match=r"afgsa|AFGSA"):
            load_published("afgsa", {**weights, name: torch.zeros(shape)})


def test_tables_of_rows_and_columns_are_not_mistaken_for_each_other() -> None:
    weights = authors_afgsa()
    names = [f"transformer_blocks.0.attention.rel_{axis}" for axis in "hw"]
    swapped = {**weights, names[0]: weights[names[1]], names[1]: weights[names[0]]}
    with pytest.raises(ValueError, match="afgsa: "):
        load_published("afgsa", swapped)


def test_names_that_are_no_words_are_refused() -> None:
    with pytest.raises(ValueError, match="afgsa: expected names and tensors"):
        load_published("afgsa", {1: torch.zeros(1)})  # type: ignore[call-overload]


def test_weights_of_another_network_are_refused_as_afgsas() -> None:
    with pytest.raises(ValueError, match="afgsa: not the entries of the authors' generator"):
        load_published("afgsa", WSKP().state_dict())


def test_windows_of_the_papers_larger_blocks_are_recognised() -> None:
    torch.manual_seed(0)
    network = load_published("afgsa", PlainAFGSA(8, 1, 1, block=16, halo=5).state_dict())
    assert (network.multiple, network.halo) == (16, 23)
    with pytest.raises(
        ValueError, match="afgsa: windows of 10 pixels are not the authors'; expected 14 or 26"
    ):
        load_published("afgsa", PlainAFGSA(8, 1, 1, block=4, halo=3).state_dict())


def test_an_unknown_method_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'afgsb'; known: wskp, afgsa"):
        load_published("afgsb", {})  # type: ignore[call-overload]
