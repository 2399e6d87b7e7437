"""KPCN equals its literal transcription; every feature by hand; wrong and extreme inputs."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from models import KPCN
from models.denoiser import select
from tests.models.behaviour import assert_bfloat16_stays_near_float32
from tests.models.frames import largest_relative, split_buffers
from tests.models.plain_kpcn import differences, plain_features, plain_kpcn
from trainer.export import SUFFIXES, export, load_artifact
from trainer.export.entry import example
from trainer.export.parity import relative_error

EPSILON = 0.00316
SMALL: dict[str, Any] = {"width": 6, "layers": 3, "kernel_size": 5}


def small(seed: int = 0, **options: Any) -> KPCN:
    torch.manual_seed(seed)
    network = KPCN(**{**SMALL, **options}).eval()
    for parameter in network.parameters():
        if parameter.dim() == 1:
            torch.nn.init.uniform_(parameter, -0.1, 0.1)
    return network


def frame(batch: int = 2, height: int = 19, width: int = 23, seed: int = 0) -> dict[str, Tensor]:
    return {name: value.double() for name, value in split_buffers(batch, height, width, seed).items()}


def parameters(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def test_published_parameter_counts() -> None:
    network = KPCN()
    assert parameters(network) == 5_842_482
    assert [parameters(b) for b in network.branches.values()] == [2_921_241, 2_921_241]
    assert parameters(KPCN(branches="single")) == 2_921_241
    assert parameters(KPCN(branches="single", features="qbhan")) == 2_923_741
    assert network.halo == 19


def test_published_layer_shapes_and_initialisation() -> None:
    state = KPCN().state_dict()
    shapes = [tuple(state[f"branches.diffuse.convolutions.{i}.weight"].shape) for i in range(9)]
    assert shapes == [(100, 27, 5, 5), *[(100, 100, 5, 5)] * 7, (441, 100, 5, 5)]
    assert all(not value.any() for name, value in state.items() if name.endswith("bias"))
    bound = (6 / (25 * (100 + 100))) ** 0.5
    middle = state["branches.specular.convolutions.4.weight"]
    assert 0.99 * bound < middle.abs().max() <= bound


@pytest.mark.parametrize("border", ["reflect", "zero"])
@pytest.mark.parametrize(("features", "channels"), [("sbmc", 27), ("qbhan", 28)])
@pytest.mark.parametrize("slip", [False, True])
def test_it_equals_the_literal_transcription(border: str, features: str, channels: int, slip: bool) -> None:
    network = small(border=border, features=features, sbmc_compat=slip).double()
    buffers = frame()
    with torch.no_grad():
        found = network(buffers).color
    expected = plain_kpcn(network.state_dict(), buffers, 5, border, slip, channels)
    assert largest_relative(found, expected) < 1e-10


def tiny() -> dict[str, Tensor]:
    """Two by two pixels of plain numbers."""

    def image(*planes: list[list[float]]) -> Tensor:
        return torch.tensor([planes], dtype=torch.float64)

    return {
        "diffuse": image([[1, 2], [3, 4]], [[0, 0], [0, 1]], [[1, 1], [1, 1]]),
        "specular": image([[0, 1], [3, 7]], [[0, 0], [0, 0]], [[1, 1], [1, 1]]),
        "albedo": image([[0.5, 0.5], [0.5, 0.25]], [[1, 1], [1, 1]], [[1, 1], [1, 1]]),
        "normal": image([[0, 1], [0, 0]], [[0, 0], [1, 0]], [[1, 0], [0, 0]]),
        "depth": image([[2, 4], [8, 1]]),
        "diffuse_variance": image([[3, 0], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 6]]),
        "specular_variance": image([[0, 3], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 9]]),
        "albedo_variance": image([[0.3, 0], [0, 0]], [[0, 0], [0, 0]], [[0.6, 0], [0, 0]]),
        "normal_variance": image([[0, 0.9], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 0]]),
        "depth_variance": image([[64, 0], [0, 16]]),
    }


def test_every_feature_by_hand() -> None:
    found = KPCN(**SMALL).double().network_input(tiny())["specular"][0]
    log2, zero = 0.6931471805599453, [[0.0, 0.0], [0.0, 0.0]]
    planes: list[Any] = [[[0, log2], [2 * log2, 3 * log2]], zero, [[log2] * 2] * 2]  # log(1 + s)
    planes += [[[0, 1], [0, 0]], [[0, 0], [0, -1]], [[0, -1], [0, 0]]]  # normal, x
    planes += [[[0, 0], [0, -1]], [[0, 0], [1, 0]], [[0, 0], [-1, 0]]]  # normal, y
    planes += [[[0, 0.3], [0, 0]]]  # normal variance, mean over channels
    planes += [[[0, 0.25], [0, -0.875]], [[0, 0], [0.75, -0.375]]]  # depth / 8, x and y
    planes += [[[1, 0], [0, 0.25]]]  # depth variance / 64
    planes += [[[0, 0], [0, -0.25]], zero, zero, [[0, 0], [0, -0.25]], zero, zero]  # albedo, x and y
    planes += [[[0.3, 0], [0, 0]]]  # albedo variance
    planes += [[[0, log2], [0, log2]], zero, zero, [[0, 0], [2 * log2, 2 * log2]], zero, zero]  # log(1 + s)
    above = (4 + 1 + 4) / 3 + 1e-5  # mean of (1 + s)^2 at s = 1, 0, 1
    below = (64 + 1 + 4) / 3 + 1e-5
    planes += [[[0, 1 / above], [0, 3 / below]]]
    assert len(planes) == 27
    torch.testing.assert_close(found, torch.tensor(planes, dtype=torch.float64), rtol=1e-12, atol=1e-12)


def test_diffuse_is_divided_by_the_albedo_and_its_variance_by_the_square() -> None:
    buffers = tiny()
    found = KPCN(**SMALL).double().network_input(buffers)["diffuse"][0]
    assert found[0, 0, 1].item() == pytest.approx(2 / 0.50316)
    squares = (0.25316**2 + 2 * 1.00316**2) / 3
    assert found[26, 1, 1].item() == pytest.approx(2 / squares)
    assert torch.equal(found[20], differences(found[None, :3])[0][0])


def test_sbmc_compat_repeats_the_slip_in_the_specular_variance_only() -> None:
    correct = KPCN(**SMALL).double().network_input(tiny())
    compat = KPCN(**SMALL, sbmc_compat=True).double().network_input(tiny())
    assert torch.equal(correct["diffuse"], compat["diffuse"])
    assert torch.equal(correct["specular"][:, :26], compat["specular"][:, :26])
    log2 = 0.6931471805599453
    squares = (2 * (1 + log2) ** 2 + 1) / 3 + 1e-5
    assert compat["specular"][0, 26, 0, 1].item() == pytest.approx(1 / squares)


@pytest.mark.parametrize(("transform", "channels"), [("log", 27), ("demodulated", 28)])
def test_a_single_branch_reads_color(transform: str, channels: int) -> None:
    features = "sbmc" if channels == 27 else "qbhan"
    network = small(branches="single", transform=transform, features=features).double()
    buffers = frame()
    expected, _ = plain_features(buffers, "color", transform, channels=channels)
    torch.testing.assert_close(network.network_input(buffers)["branch"], expected, rtol=1e-12, atol=1e-12)
    pairs = network.training_pairs(buffers)
    demodulator = buffers["albedo"] + EPSILON
    reference = buffers["reference"].float().double()
    target = reference.log1p() if transform == "log" else reference / demodulator
    torch.testing.assert_close(pairs["branch"].target, target)
    back = pairs["branch"].output
    back = back.expm1() if transform == "log" else back * demodulator
    torch.testing.assert_close(network(buffers).color, back)
    assert "diffuse" not in network.inputs
    assert network.targets == ("reference",)
    assert ("albedo_variance" in network.inputs) == (channels == 27)


def test_training_compares_branches_in_transformed_space_and_exposed_color() -> None:
    network, buffers = small(), split_buffers(2, 20, 24)
    exposure = torch.tensor([0.5, 2.0])
    scale = exposure.reshape(2, 1, 1, 1)
    pairs = network.training_pairs({**buffers, "exposure": exposure})
    diffuse, reference = buffers["reference_diffuse"] * scale, buffers["reference"] * scale
    torch.testing.assert_close(pairs["diffuse"].target, diffuse / (buffers["albedo"] + EPSILON))
    torch.testing.assert_close(pairs["specular"].target, (reference - diffuse).clamp_min(0).log1p())
    torch.testing.assert_close(pairs["color"].target, reference)
    color = network({**select(network, buffers), "exposure": exposure}).color * scale
    torch.testing.assert_close(pairs["color"].output, color)


def test_padding_changes_only_pixels_that_see_the_border() -> None:
    once, layers, buffers = small(), small(padding="layers"), split_buffers(1, 40, 44)
    with torch.no_grad():
        difference = (once(buffers).color - layers(buffers).color).abs()
    assert difference[..., 6:-6, 6:-6].max() < 1e-5
    assert difference.max() > 1e-4


def test_strips_of_inference_equal_the_training_form(monkeypatch: pytest.MonkeyPatch) -> None:
    network, buffers = small().double(), frame()
    expected = network(buffers).color.detach()
    monkeypatch.setattr("models.ops.gather._CHUNK", 2 * 23 * 3)
    with torch.no_grad():
        assert largest_relative(network(buffers).color, expected) < 1e-12


@pytest.mark.parametrize("broken", [float("nan"), float("inf"), -float("inf"), -5.0])
def test_broken_values_in_any_buffer_stay_where_they_are(broken: float) -> None:
    network = small()
    for name in network.inputs:
        buffers = split_buffers(1, 40, 40)
        buffers[name][..., 3, 4] = broken
        color = network(buffers).color
        assert color.isfinite().all(), name
        assert (color >= 0).all(), name
        color.mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_negative_radiance_counts_as_black() -> None:
    network, buffers = small(), split_buffers(1, 20, 20)
    buffers["diffuse"][..., 5, 5] = -3.0
    black = {**buffers, "diffuse": buffers["diffuse"].clamp_min(0)}
    with torch.no_grad():
        assert torch.equal(network(buffers).color, network(black).color)


def test_fireflies_are_clipped_for_the_network_and_not_in_the_image() -> None:
    network, buffers = small(feature_limit=50.0), split_buffers(1, 20, 20)
    buffers["diffuse"][..., 9, 9] = 1e4
    assert network.network_input(buffers)["diffuse"].abs().max() == 50
    with torch.no_grad():
        assert network(buffers).color.max() > 100


def test_a_frame_without_surfaces_is_denoised() -> None:
    buffers = split_buffers(1, 20, 20)
    for name in ("normal", "depth", "normal_variance", "depth_variance"):
        buffers[name].zero_()
    assert small()(buffers).color.isfinite().all()


def test_bfloat16_stays_near_float32() -> None:
    assert_bfloat16_stays_near_float32(small(), split_buffers(1, 32, 32))


def test_a_missing_split_is_named() -> None:
    buffers = split_buffers(1, 20, 20)
    del buffers["diffuse"], buffers["diffuse_variance"]
    with pytest.raises(ValueError, match=r"KPCN needs .* missing: diffuse, diffuse_variance"):
        KPCN(**SMALL)(buffers)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"kernel_size": 4}, "kernel_size must be odd"),
        ({"feature_limit": 0.0}, "feature_limit must lie between"),
        ({"layers": 1}, "at least 2 layers"),
        ({"features": "bako"}, "features 'bako'; expected one of sbmc, qbhan"),
        ({"branches": "both"}, "branches 'both'"),
    ],
)
def test_wrong_arguments_are_named(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KPCN(**wrong)


@pytest.mark.parametrize("kind", ["onnx", "torchscript"])
def test_exported_files_compute_the_same_at_every_size(kind: str, tmp_path: Any) -> None:
    network = small()
    path = tmp_path / f"kpcn{SUFFIXES[kind]}"
    export(network, path, kind)  # type: ignore[arg-type]
    artifact = load_artifact(path)
    for height, width in ((17, 40), (33, 16)):
        buffers = example(network.inputs, 2, height, width)
        with torch.no_grad():
            assert relative_error(artifact(buffers).color, network(buffers).color) < 1e-4
