"""ACFM: sizes, a literal transcription, preprocessing, what training compares, wrong input, export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from models import ACFM
from models.acfm import Generator
from models.denoiser import select
from tests.models.frames import largest_relative, split_buffers
from tests.models.plain_acfm import PlainACFM, plain_color, plain_copy, plain_logs
from trainer.export import export, load_artifact
from trainer.export.parity import relative_error

NARROW: dict[str, Any] = {"blocks": 2, "width": 8, "condition_width": 12, "condition": 4}


def narrow(seed: int = 0, **options: Any) -> ACFM:
    torch.manual_seed(seed)
    return ACFM(**{**NARROW, "start": 0.5, **options})


def doubled(buffers: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.double() for name, value in buffers.items()}


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameter_counts_are_the_published_ones() -> None:
    network = ACFM()
    assert count(network.diffuse) == count(network.specular) == count(PlainACFM()) == 1_530_019
    assert count(network) == 3_060_038
    assert count(network.diffuse.body.modulation) == 6_336
    groups = {name: sum(p.numel() for p in group) for name, group in network.parameter_groups().items()}
    condition = (7 * 9 + 1) * 128 + 3 * (128 + 1) * 128 + (128 + 1) * 32
    assert groups["modulation"] == 2 * (33 * 6_336 + condition)
    assert sum(groups.values()) == 3_060_038


def test_the_published_fast_group_lacks_only_head_and_tail() -> None:
    network = ACFM(groups="published")
    slow = {id(p) for p in network.parameter_groups()["base"]}
    names = {name.split(".", 1)[1] for name, p in network.named_parameters() if id(p) in slow}
    layers = ("head", "tail", "last")
    assert names == {f"{layer}.{kind}" for layer in layers for kind in ("weight", "bias")}


def test_layers_are_the_published_ones() -> None:
    shapes = {name: tuple(p.shape) for name, p in ACFM().diffuse.named_parameters() if name[-6:] == "weight"}
    expected: dict[str, tuple[int, ...]] = {"condition.0.weight": (128, 7, 3, 3)}
    expected |= {f"condition.{i}.weight": (128, 128, 1, 1) for i in (2, 4, 6)}
    expected |= {"condition.8.weight": (32, 128, 1, 1), "head.weight": (64, 3, 3, 3)}
    expected |= {"tail.weight": (64, 64, 3, 3), "last.weight": (3, 64, 3, 3)}
    for half in ("body", *(f"blocks.{i}.{name}" for i in range(16) for name in ("first", "second"))):
        for name in ("scale", "shift"):
            expected[f"{half}.modulation.{name}.0.weight"] = (32, 32, 1, 1)
            expected[f"{half}.modulation.{name}.2.weight"] = (64, 32, 1, 1)
        expected[f"{half}.convolution.weight"] = (64, 64, 3, 3)
    assert shapes == expected
    assert len([name for name in shapes if "modulation.scale.0" in name]) == 33


@pytest.mark.parametrize("normal_range", ["unit", "published"])
def test_output_and_gradients_are_those_of_the_transcription(normal_range: str) -> None:
    network = narrow(normal_range=normal_range).double()
    plain = {name: plain_copy(getattr(network, name)) for name in ("diffuse", "specular")}
    buffers = doubled(split_buffers(2, 19, 22))
    expected = plain_logs(network, plain, buffers)
    found = network.predict(buffers)
    for name in plain:
        assert expected[name].amax() > 0.1
        torch.testing.assert_close(getattr(found, name), expected[name], rtol=1e-10, atol=1e-12)
    color = network(buffers).color
    torch.testing.assert_close(color, plain_color(expected, buffers["albedo"]), rtol=1e-10, atol=1e-12)
    color.square().sum().backward()
    plain_color(expected, buffers["albedo"]).square().sum().backward()
    for name, theirs in plain.items():
        sums = [
            sorted(float(p.grad.abs().sum()) for p in module.parameters() if p.grad is not None)
            for module in (theirs, getattr(network, name))
        ]
        assert len(sums[0]) == len(list(theirs.parameters()))
        torch.testing.assert_close(torch.tensor(sums[0]), torch.tensor(sums[1]), rtol=1e-8, atol=0)


def test_one_modulation_by_hand() -> None:
    half = Generator(1, 1, 1, 1).body
    with torch.no_grad():
        for name, (first, second, bias) in {"scale": (2.0, 3.0, 0.5), "shift": (-1.0, 10.0, 0.25)}.items():
            layers = dict(half.modulation.named_children())[name]
            for index, (weight, offset) in {0: (first, 0.0), 2: (second, bias)}.items():
                nn.init.constant_(layers.get_parameter(f"{index}.weight"), weight)
                nn.init.constant_(layers.get_parameter(f"{index}.bias"), offset)
        half.convolution.weight.zero_()
        half.convolution.weight[0, 0, 1, 1] = 1.0
        nn.init.zeros_(half.convolution.bias)  # type: ignore[arg-type]
    found = half(torch.full((1, 1, 3, 3), 5.0), torch.full((1, 1, 3, 3), 4.0))
    # scale = 3 * (2 * 4) + 0.5 = 24.5; shift = 10 * 0.1 * (-4) + 0.25 = -3.75; 5 * (1 + 24.5) - 3.75
    torch.testing.assert_close(found, torch.full((1, 1, 3, 3), 123.75))


def test_components_are_put_together_as_published(monkeypatch: pytest.MonkeyPatch) -> None:
    network, buffers = narrow(), split_buffers(1, 16, 16)
    monkeypatch.setattr(network.diffuse, "forward", lambda *_: torch.full((1, 3, 16, 16), 2.0).log())
    monkeypatch.setattr(network.specular, "forward", lambda *_: torch.full((1, 3, 16, 16), 4.0).log())
    # (albedo + 0.00316) * (2 - 1) + (4 - 1), divided by the exposure
    expected = (buffers["albedo"] + 3.00316) / 2
    torch.testing.assert_close(network({**buffers, "exposure": torch.tensor([2.0])}).color, expected)


def test_the_networks_see_what_the_authors_feed_them() -> None:
    network, buffers = narrow(), split_buffers(2, 16, 18)
    guides = network._guides(buffers)
    torch.testing.assert_close(guides[:, :3], (buffers["normal"] + 1) / 2)
    depth = buffers["depth"]
    torch.testing.assert_close(guides[:, 3:4], depth / depth.amax((1, 2, 3), keepdim=True))
    assert torch.equal(guides[:, 4:], buffers["albedo"])
    exposed = {**buffers, "exposure": torch.tensor([0.5, 3.0])}
    logs = network._logs(exposed, buffers["diffuse"], buffers["specular"])
    factor = exposed["exposure"].reshape(2, 1, 1, 1)
    demodulated = factor * buffers["diffuse"] / (buffers["albedo"] + 0.00316)
    torch.testing.assert_close(logs.diffuse, torch.log(1 + demodulated))
    torch.testing.assert_close(logs.specular, torch.log(1 + factor * buffers["specular"]))


@pytest.mark.parametrize(("scale", "training", "whole"), [("frame", True, True), ("crop", True, False),
                                                          ("crop", False, True)])  # fmt: skip
def test_depth_is_divided_by_the_frames_largest_or_in_training_by_the_crops(
    scale: str, training: bool, whole: bool
) -> None:
    network = narrow(depth_scale=scale).train(training)
    buffers = {**split_buffers(1, 16, 16), "depth_range": torch.tensor([[1.0, 20.0]])}
    largest = 20.0 if whole else buffers["depth"].amax()
    torch.testing.assert_close(network._guides(buffers)[:, 3:4], buffers["depth"] / largest)


def test_training_compares_logarithms_of_the_components() -> None:
    network = narrow()
    batch = {**split_buffers(2, 16, 16), "exposure": torch.tensor([0.5, 2.0])}
    pairs = network.training_pairs(batch)
    factor, diffuse = batch["exposure"].reshape(2, 1, 1, 1), batch["reference_diffuse"]
    specular = (batch["reference"] - diffuse).clamp_min(0)
    expected = torch.log(1 + factor * diffuse / (batch["albedo"] + 0.00316))
    torch.testing.assert_close(pairs["diffuse"].target, expected)
    torch.testing.assert_close(pairs["specular"].target, torch.log(1 + factor * specular))
    assert torch.equal(pairs["diffuse"].output, network.predict(batch).diffuse)
    assert torch.equal(pairs["specular"].output, network.predict(batch).specular)


def test_the_two_networks_share_nothing() -> None:
    network, batch = narrow(), split_buffers(1, 16, 16)
    network.training_pairs(batch)["diffuse"].output.sum().backward()
    assert all(p.grad is None for p in network.specular.parameters())
    assert all(p.grad is not None for p in network.diffuse.parameters())


def test_weights_start_a_tenth_as_wide_as_kaimings_without_biases() -> None:
    network = Generator(2, 64, 128, 32)
    network.start(0.1)
    for name, parameter in network.named_parameters():
        if name.endswith("bias"):
            assert (parameter == 0).all()
        elif parameter.numel() > 10_000:
            expected = 0.1 * (2 / parameter[0].numel()) ** 0.5
            assert abs(parameter.std().item() / expected - 1) < 0.05


def test_no_channel_starts_dead() -> None:
    buffers = split_buffers(1, 16, 16)
    for seed in range(6):
        for logs in narrow(seed, width=32, start=0.1).predict(buffers):
            assert (logs.amax((0, 2, 3)) > 0).all()


@pytest.mark.parametrize("checkpointed", [1, 2])
def test_checkpointed_blocks_change_no_gradient(checkpointed: int) -> None:
    gradients = []
    for number in (0, checkpointed):
        network = narrow(checkpointed=number)
        network(split_buffers(1, 16, 16)).color.sum().backward()
        gradients.append([p.grad for p in network.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)


def test_bfloat16_stays_near_float32() -> None:
    network, batch = narrow(), split_buffers(1, 24, 24)
    with torch.no_grad():
        exact = network(batch).color
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = network(batch).color
    assert found.dtype == torch.float32
    assert largest_relative(found, exact) < 0.1


def test_frozen_base_parameters_leave_gradients_to_the_modulation_alone() -> None:
    network, groups = narrow(), narrow().parameter_groups()
    groups = network.parameter_groups()
    for parameter in groups["base"]:
        parameter.requires_grad_(False)
    network(split_buffers(1, 16, 16)).color.sum().backward()
    assert all(p.grad is None for p in groups["base"])
    assert all(p.grad is not None and p.grad.isfinite().all() for p in groups["modulation"])


def test_a_frame_without_a_split_is_refused() -> None:
    buffers = {k: v for k, v in split_buffers(1, 16, 16).items() if k not in ("diffuse", "specular")}
    with pytest.raises(ValueError, match="missing: diffuse, specular"):
        narrow()(buffers)


@pytest.mark.parametrize("value", [float("nan"), float("-inf"), -3.0])
@pytest.mark.parametrize("name", ["diffuse", "specular"])
def test_radiance_that_cannot_be_counts_as_0(name: str, value: float) -> None:
    network, buffers = narrow(), split_buffers(1, 16, 16)
    wrong, black = buffers[name].clone(), buffers[name].clone()
    wrong[..., 3:6, 7], black[..., 3:6, 7] = value, 0.0
    expected = network({**buffers, name: black}).color
    assert expected.isfinite().all()
    assert torch.equal(network({**buffers, name: wrong}).color, expected)


@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["normal", "depth", "albedo"])
def test_guides_without_a_value_stay_finite(name: str, value: float) -> None:
    network, buffers = narrow(), split_buffers(1, 16, 16)
    buffers[name] = torch.full_like(buffers[name], value)
    pairs = network.training_pairs({**buffers, **network.measure(buffers)})
    sum(pair.output.sum() + pair.target.sum() for pair in pairs.values()).backward()  # type: ignore[union-attr]
    assert network(buffers).color.isfinite().all()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


@pytest.mark.parametrize("format", ["onnx", "torchscript"])
def test_artifacts_agree_at_other_sizes(tmp_path: Path, format: str) -> None:
    network = narrow().eval()
    path = tmp_path / ("acfm.onnx" if format == "onnx" else "acfm.pt")
    export(network, path, format)  # type: ignore[arg-type]
    artifact, buffers = load_artifact(path), select(network, split_buffers(2, 23, 37))
    with torch.no_grad():
        assert relative_error(artifact(buffers).color, network(buffers).color) < 1e-4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"blocks": -1}, "blocks is too small"),
        ({"width": 0}, "width is too small"),
        ({"normal_range": "raw"}, "normal_range"),
        ({"depth_scale": "tile"}, "depth_scale must be 'frame' or 'crop', got 'tile'"),
        ({"groups": "all"}, "groups must be 'modulation' or 'published'"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ACFM(**{**NARROW, **options})
