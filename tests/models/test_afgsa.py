"""AFGSA is the network of its paper: sizes, equations, ablations, borders and robustness."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from models import AFGSA
from models.published import load_published
from tests.models.frames import largest_relative, split_buffers
from tests.models.plain_afgsa import PlainAFGSA
from trainer.export import export

SMALL: dict[str, Any] = {"width": 16, "blocks": 2, "heads": 2}
VARIANTS: list[dict[str, Any]] = [
    {},
    {"mask_halo": True, "block": 4, "halo": 5},
    {"guidance": "concatenate", "kernel_sizes": (3, 5, 7)},
    {"guidance": "none"},
    {"auxiliary": ("albedo",)},
    {"attention": "local", "window": 7},
    {"attention": "local", "window": 9, "mask_halo": True},
]

TINY: dict[str, Any] = {"width": 8, "blocks": 1, "heads": 1}
ABLATIONS: list[dict[str, Any]] = [
    *({**TINY, "kernel_sizes": sizes} for sizes in ((1, 3, 5, 7), (3,), (5,), (7,))),
    {**TINY, "block": 16, "halo": 5},
    {"width": 8, "blocks": 4, "heads": 1, "attention": "local", "window": 3},
    {**TINY, "auxiliary": ("normal", "depth")},
]
"""Rows of the paper's tables 2 to 4 and figure 9 that `VARIANTS` lack."""


def small(**arguments: Any) -> AFGSA:
    torch.manual_seed(5)
    return AFGSA(**{**SMALL, **arguments}).eval()


def double(buffers: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.double() for name, value in buffers.items()}


def as_the_paper_reads(buffers: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return log colour and the seven auxiliary channels."""
    depth = buffers["depth"] / buffers["depth"].amax((1, 2, 3), keepdim=True)
    aux = torch.cat([(buffers["normal"] + 1) / 2, depth, buffers["albedo"]], 1)
    return torch.log1p(buffers["color"]), aux


def count(network: AFGSA) -> int:
    return sum(p.numel() for p in network.parameters())


def parameters(
    sizes: tuple[int, ...] = (1, 3, 5), aux: int = 7, blocks: int = 5, side: int = 14, w: int = 256
) -> int:
    """Count by hand, from the table of the network's layers."""

    def extractor(inputs: int) -> int:
        return sum(w * inputs * k * k + w for k in sizes) + w * w * len(sizes) + w

    attention = 2 * w * w + w + 3 * w * w + 2 * side * 32
    block = attention + 2 * (9 * w * w + w)
    decoder = 2 * (9 * w * w + w) + 9 * w * 3 + 3
    return extractor(3) + extractor(aux) + w * w + w + blocks * block + decoder


def test_the_published_network_has_9282691_parameters() -> None:
    assert count(AFGSA()) == parameters() == 9_282_691


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"kernel_sizes": (1, 3, 5, 7)}, parameters((1, 3, 5, 7))),
        ({"kernel_sizes": (3, 5, 7)}, parameters((3, 5, 7))),
        ({"kernel_sizes": (3,)}, parameters((3,))),
        ({"kernel_sizes": (5,)}, parameters((5,))),
        ({"kernel_sizes": (7,)}, parameters((7,))),
        ({"blocks": 4}, parameters(blocks=4)),
        ({"blocks": 6}, parameters(blocks=6)),
        ({"block": 16, "halo": 5}, parameters(side=26)),
        ({"attention": "local", "window": 7}, parameters(side=7)),
        ({"attention": "local", "window": 9}, parameters(side=9)),
        ({"auxiliary": ("normal",)}, parameters(aux=3)),
        ({"auxiliary": ("albedo", "depth")}, parameters(aux=4)),
        ({"guidance": "concatenate"}, parameters()),
        # No auxiliary extractor (35 taps of 7 inputs), and no fusion in the five blocks.
        (
            {"guidance": "none"},
            parameters() - (35 * 7 * 256 + 3 * 256 + 769 * 256 + 257 * 256) - 5 * 513 * 256,
        ),
    ],
    ids=str,
)
def test_ablations_have_as_many_parameters_as_their_layers(arguments: dict[str, Any], expected: int) -> None:
    with torch.device("meta"):
        assert count(AFGSA(**arguments)) == expected


def test_layers_have_the_published_shapes() -> None:
    with torch.device("meta"):
        shapes = {name: tuple(p.shape) for name, p in AFGSA().named_parameters()}
    assert shapes["color_features.branches.2.weight"] == (256, 3, 5, 5)
    assert shapes["color_features.fusion.weight"] == (256, 768, 1, 1)
    assert shapes["auxiliary_features.branches.0.weight"] == (256, 7, 1, 1)
    assert shapes["auxiliary_features.second.weight"] == (256, 256, 1, 1)
    assert shapes["blocks.4.attention.rows"] == shapes["blocks.4.attention.columns"] == (14, 32)
    assert shapes["blocks.0.attention.fusion.weight"] == (256, 512, 1, 1)
    assert shapes["blocks.0.attention.query.weight"] == (256, 256, 1, 1)
    assert shapes["blocks.0.first.weight"] == shapes["decoder.1.weight"] == (256, 256, 3, 3)
    assert shapes["residual.weight"] == (3, 256, 3, 3)
    assert not any(name.endswith(("query.bias", "key.bias", "value.bias")) for name in shapes)


def test_initial_values_are_the_authors() -> None:
    torch.manual_seed(0)
    attention: Any = AFGSA(blocks=1).blocks[0].attention
    for projection in (attention.query, attention.key, attention.value):
        assert projection.weight.std().item() == pytest.approx((2 / 256) ** 0.5, rel=0.02)
    assert attention.rows.std().item() == pytest.approx(1, rel=0.2)


@pytest.mark.parametrize("mask_halo", [False, True])
def test_output_and_gradients_are_the_literal_networks(mask_halo: bool) -> None:
    torch.manual_seed(1)
    plain = PlainAFGSA(16, 2, 2, mask_halo=mask_halo).double()
    network = AFGSA(**SMALL, mask_halo=mask_halo).double()
    network.load_state_dict(load_published("afgsa", plain.state_dict()).state_dict())
    buffers = double(split_buffers(2, 24, 32))
    color, aux = as_the_paper_reads(buffers)
    color.requires_grad_()
    expected = plain(color, aux)
    buffers["color"].requires_grad_()
    found = network.predict(buffers)
    assert largest_relative(found, expected) < 1e-10
    weights = torch.rand_like(expected)
    expected.backward(weights)
    found.backward(weights)
    theirs = load_published("afgsa", {n: p.grad for n, p in plain.named_parameters()}).double()
    for (name, ours), other in zip(network.named_parameters(), theirs.parameters(), strict=True):
        assert ours.grad is not None
        assert largest_relative(ours.grad, other) < 1e-6, name  # load_published rounds to float32
    assert color.grad is not None
    assert buffers["color"].grad is not None
    assert largest_relative(buffers["color"].grad * (1 + buffers["color"]), color.grad) < 1e-10


def test_the_log_output_becomes_radiance_that_is_never_negative() -> None:
    network, buffers = small(), split_buffers(1, 16, 16)
    with torch.no_grad():
        assert network.residual.bias is not None
        network.residual.bias.fill_(-0.5)
        log, color = network.predict(buffers), network(buffers).color
    assert log.min() < 0
    torch.testing.assert_close(color, torch.expm1(log).clamp_min(0))


def test_training_compares_logs_before_clamping() -> None:
    network, batch = small(), split_buffers(2, 16, 16)
    batch["exposure"] = torch.tensor([0.5, 3.0])
    with torch.no_grad():
        pair = network.training_pairs(batch)["color"]
        torch.testing.assert_close(pair.output, network.predict(batch))
    exposed = batch["reference"] * torch.tensor([0.5, 3.0])[:, None, None, None]
    torch.testing.assert_close(pair.target, torch.log1p(exposed))


@pytest.mark.parametrize("arguments", VARIANTS, ids=str)
def test_every_variant_runs_at_any_size_and_trains(arguments: dict[str, Any]) -> None:
    network, batch = small(**arguments), split_buffers(1, 19, 26)
    assert network.predict(batch).shape == (1, 3, 19, 26)
    pair = network.training_pairs(batch)["color"]
    (pair.output - pair.target).abs().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize("arguments", [*VARIANTS, *ABLATIONS], ids=str)
def test_the_halo_of_every_variant_is_its_reach(arguments: dict[str, Any]) -> None:
    network = small(**arguments).double()
    side, halo = network.multiple, network.halo
    before = -(-(halo + 2) // side) * side
    size = 2 * before + side
    buffers = double(split_buffers(1, size, size))
    buffers["depth_range"] = torch.tensor([[1.0, 6.0]]).double()
    images = [buffers[name].requires_grad_() for name in network.inputs]
    core = slice(before, before + side)
    total = network.predict(buffers)[..., core, core].square().sum()
    reached = sum(g[0].abs().sum(0) for g in torch.autograd.grad(total, images))
    assert isinstance(reached, Tensor)
    rows = (reached > 0).any(1).nonzero()
    assert max(before - int(rows.min()), int(rows.max()) - (before + side - 1)) == halo


def test_the_published_networks_depend_on_45_and_87_pixels() -> None:
    with torch.device("meta"):
        assert AFGSA().halo == 45
        assert AFGSA(block=16, halo=5).halo == 87


def test_a_shift_by_a_block_shifts_the_interior() -> None:
    network = small(blocks=1).double()
    margin = 8 + network.halo + 3
    buffers = double(split_buffers(1, 64, 64))
    buffers["depth_range"] = torch.tensor([[1.0, 6.0]]).double()
    shifted = {n: b if n == "depth_range" else b.roll((8, 8), (2, 3)) for n, b in buffers.items()}
    with torch.no_grad():
        found, expected = network.predict(shifted), network.predict(buffers).roll((8, 8), (2, 3))
        off = network.predict({n: b if b.ndim < 4 else b.roll(4, 3) for n, b in buffers.items()})
    inner = slice(margin, 64 - margin)
    assert largest_relative(found[..., inner, inner], expected[..., inner, inner]) < 1e-12
    moved = network.predict(buffers).roll(4, 3)
    assert largest_relative(off[..., inner, inner], moved[..., inner, inner]) > 1e-6


@pytest.mark.parametrize("checkpointed", [1, 2])
def test_checkpointed_blocks_give_the_same_gradients(checkpointed: int) -> None:
    batch = split_buffers(1, 16, 24)
    gradients = []
    for number in (0, checkpointed):
        network = small(checkpointed=number)
        network.training_pairs(batch)["color"].output.square().mean().backward()
        gradients.append([p.grad for p in network.parameters()])
    for one, other in zip(*gradients, strict=True):
        assert one is not None
        assert other is not None
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("mask_halo", [False, True])
def test_attention_maps_are_the_literal_networks(mask_halo: bool) -> None:
    torch.manual_seed(2)
    plain = PlainAFGSA(16, 2, 2, mask_halo=mask_halo)
    network = AFGSA(**SMALL, mask_halo=mask_halo)
    network.load_state_dict(load_published("afgsa", plain.state_dict()).state_dict())
    buffers = split_buffers(1, 24, 24)
    color, aux = as_the_paper_reads(buffers)
    x = plain.conv_map(torch.cat([plain.conv1(color), plain.conv3(color), plain.conv5(color)], 1))
    a = plain.conv_aenc2(
        plain.conv_aenc1(torch.cat([plain.conv_a1(aux), plain.conv_a3(aux), plain.conv_a5(aux)], 1))
    )
    for row, column in ((9, 13), (0, 23)):
        maps = network.attention(buffers, row, column)
        assert maps.shape == (2, 2, 24, 24)
        block: Any = plain.transformer_blocks[0]
        number, place = row // 8 * 3 + column // 8, row % 8 * 8 + column % 8
        window = torch.zeros(2, 30, 30)
        top, left = row // 8 * 8, column // 8 * 8
        weights = block.attention.weights(x, a)[0, number, :, place].reshape(2, 14, 14)
        window[:, top : top + 14, left : left + 14] = weights
        torch.testing.assert_close(maps[0], window[:, 3:27, 3:27].detach())
        inside = mask_halo or (row, column) == (9, 13)
        assert torch.allclose(maps.sum((-2, -1)), torch.ones(2, 2)) == inside


def test_a_query_outside_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"row 20, column 3.*rows 0 to 16"):
        small().attention(split_buffers(1, 17, 20), 20, 3)
    with pytest.raises(ValueError, match="one image, got a batch of 2"):
        small().attention(split_buffers(2, 17, 20), 2, 3)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), -3.0, 1e9])
def test_wild_radiance_gives_finite_images_and_gradients(value: float, precision: str) -> None:
    network, batch = small(), split_buffers(1, 16, 16)
    batch["color"][..., 3:5, 7] = value
    batch["normal"][..., 9] = 0
    batch["normal"][..., 10] = float("nan")
    batch["depth"][..., 11] = float("inf")
    batch["albedo"][..., 12] = float("nan")
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        assert network(batch).color.isfinite().all()
        pair = network.training_pairs(batch)["color"]
    assert pair.output.dtype == torch.float32
    (pair.output - pair.target).abs().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_nan_and_negative_radiance_count_as_black() -> None:
    network, black = small(), split_buffers(1, 16, 16)
    black["color"][..., 2:6, 3] = 0
    wild = {**black, "color": black["color"].clone()}
    wild["color"][..., 2:4, 3], wild["color"][..., 4:6, 3] = float("nan"), -7.0
    with torch.no_grad():
        assert torch.equal(network(wild).color, network(black).color)


def test_normals_and_depth_that_are_zero_everywhere_stay_finite() -> None:
    network, buffers = small(), split_buffers(1, 16, 16)
    buffers["normal"].zero_()
    buffers["depth"].zero_()
    with torch.no_grad():
        assert network(buffers).color.isfinite().all()


def test_bfloat16_is_close_to_float32() -> None:
    network, buffers = small(), split_buffers(1, 32, 32)
    with torch.no_grad():
        expected = network.predict(buffers)
        with torch.autocast("cpu", torch.bfloat16):
            found = network.predict(buffers)
    assert found.dtype == torch.float32
    assert largest_relative(found, expected) < 0.02


@pytest.mark.parametrize("file_format", ["onnx", "torchscript"])
def test_exported_files_agree_at_every_size(file_format: Any, tmp_path: Path) -> None:
    network = small(width=8, blocks=1, heads=1)
    assert export(network, tmp_path / "network", file_format).error < 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 20, "heads": 4}, "divides by twice the heads"),
        ({"blocks": 0}, "at least one block"),
        ({"kernel_sizes": (1, 4)}, "kernel_sizes must be odd"),
        ({"kernel_sizes": ()}, "kernel_sizes must be odd"),
        ({"kernel_sizes": (3, 3)}, "kernel_sizes must differ"),
        ({"checkpointed": 6}, "checkpointed must be 0 to 5"),
        ({"guidance": "film"}, "guidance must be"),
        ({"auxiliary": ()}, "auxiliary must name some of normal, depth, albedo, got nothing"),
        ({"auxiliary": ("position",)}, "auxiliary must name some of .* got position"),
        ({"attention": "global"}, "attention must be block or local"),
        ({"attention": "local", "window": 8}, "window must be odd"),
        ({"block": 0}, "block must be positive"),
        ({"halo": -1}, "halo not negative"),
    ],
    ids=str,
)
def test_arguments_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message), torch.device("meta"):
        AFGSA(**arguments)
