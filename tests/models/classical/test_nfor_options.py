"""NFOR with other inputs than two halves and a measured variance, and what it returns beside the image."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.classical.nfor import NFOR
from models.ops.fireflies import limited_halves
from models.ops.halves import Halves, Noise, estimated_variance, halves_variance
from models.tiling import denoise_tiled
from tests.models import plain_nfor
from tests.models.frames import split_buffers
from tests.models.plain_nlm import nlm

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

SMALL: dict[str, Any] = {"window": 2, "patch": 1, "prefilter_window": 2, "final_window": 1, "fused": False}
RADII = plain_nfor.Radii(window=2, patch=1, prefilter=2, final=1)
PARTS = ("a", "b", "variance")


@pytest.fixture
def buffers() -> dict[str, Tensor]:
    found = split_buffers(1, 18, 20)
    found["color"] = 0.5 * (found["color_a"] + found["color_b"])
    rough = 0.1 * found["depth"]
    return {**found, "roughness": rough, **{f"roughness_{p}": 0.1 * found[f"depth_{p}"] for p in PARTS}}


def image(tensor: Tensor) -> Any:
    return tensor[0].permute(1, 2, 0).double().numpy()


def test_halves_alone_give_what_their_smoothed_difference_as_variance_gives(
    buffers: dict[str, Tensor],
) -> None:
    network = NFOR(color_noise="halves", feature_noise="halves", smoothing=2, **SMALL)
    assert all(name[-2:] in ("_a", "_b") for name in network.inputs)
    for name in ("color", *network.features):
        halves = buffers[f"{name}_a"], buffers[f"{name}_b"]
        buffers[f"{name}_variance"] = halves_variance(*halves, 2)
    read = {name: buffers[name] for name in network.inputs}
    assert torch.equal(network(read).color, NFOR(**SMALL)(buffers).color)


@pytest.mark.parametrize("noise", ["variance", "estimated"])
def test_one_buffer_is_fitted_once_with_its_own_weights(buffers: dict[str, Tensor], noise: Any) -> None:
    network = NFOR(features=("albedo",), color_noise=noise, feature_noise="none", **SMALL)
    read = {name: buffers[name] for name in network.inputs}
    color, albedo = image(read["color"]), image(read["albedo"])
    variance = image(read.get("color_variance", estimated_variance(read["color"])))
    weights = plain_nfor.regression_weights(color, variance, RADII, 0.5, 1)
    expected = plain_nfor.collaborative_regression(color, albedo, weights, 2)
    found = network.details(read)
    assert found.errors is None
    assert found.selection is None
    assert np.abs(image(found.color) - expected).max() < 1e-3 * np.ptp(expected)
    assert torch.equal(found.features["albedo"], read["albedo"])


def test_each_feature_has_its_own_noise(buffers: dict[str, Tensor]) -> None:
    noises: list[Noise] = ["measured", "none", "variance"]
    network = NFOR(features=("normal", "roughness", "albedo"), feature_noise=noises, **SMALL)
    assert network.inputs[3:] == (
        *(f"normal_{part}" for part in PARTS),
        *("roughness", "albedo", "albedo_variance"),
    )
    found = network.details({name: buffers[name] for name in network.inputs}).features
    assert list(found) == ["normal", "roughness", "albedo"]
    assert torch.equal(found["roughness"], buffers["roughness"])
    albedo, variance = image(buffers["albedo"]), image(buffers["albedo_variance"])
    np.testing.assert_allclose(image(found["albedo"]), nlm(albedo, albedo, variance, 1, 2, 0.5, 1), atol=1e-5)
    alone = NFOR(features=("normal",), **SMALL).details(buffers).features["normal"]
    assert torch.equal(found["normal"], alone)


def test_layers_are_returned_when_asked_for_by_name(buffers: dict[str, Tensor]) -> None:
    assert NFOR(**SMALL)(buffers).aux is None
    found = NFOR(aux=True, features=("albedo", "roughness"), **SMALL)(buffers)
    details = NFOR(features=("albedo", "roughness"), **SMALL).details(buffers)
    assert found.aux is not None
    assert set(found.aux) == {"albedo", "roughness", "error_k0.5", "error_k1", "selection"}
    assert found.aux["roughness"].shape == (1, 1, 18, 20)
    assert details.errors is not None
    assert torch.equal(found.aux["error_k1"], details.errors[1])
    single = NFOR(aux=True, features=(), color_noise="estimated", **SMALL)(buffers)
    assert single.aux == {}


@pytest.mark.parametrize(
    ("lacking", "color", "features", "said"),
    [
        ({"color_variance"}, "halves", ["measured"] * 2, ["no color_variance"]),
        ({"color_a", "color_b"}, "variance", ["measured"] * 2, ["one bandwidth"]),
        ({"depth_a", "depth_b"}, "measured", ["measured", "variance"], ["no depth_a and no depth_b"]),
        (
            {"color_variance", "normal_variance", "depth_a"},
            "halves",
            ["halves", "variance"],
            ["no color_variance", "no normal_variance", "no depth_a"],
        ),
    ],
)
def test_what_lacks_is_done_without_and_said(
    buffers: dict[str, Tensor], lacking: set[str], color: str, features: list[str], said: list[str]
) -> None:
    network = NFOR("paper", ("normal", "depth"), aux=True, smoothing=3, **SMALL)
    available = set(buffers) - lacking
    found = network.instead(available)
    assert found is not None
    other, reasons = found
    assert isinstance(other, NFOR)
    assert list(other.noises.values()) == [color, *features]
    assert (other.preset, other.aux, other.smoothing, other.memory) == ("paper", True, 3, network.memory)
    assert set(other.inputs) <= available
    assert len(reasons) == len(said)
    assert all(part in reason for part, reason in zip(said, reasons, strict=True))
    assert other({name: buffers[name] for name in other.inputs}).color.isfinite().all()


def test_fireflies_that_cannot_be_told_any_more_are_kept_and_that_is_said(buffers: dict[str, Tensor]) -> None:
    found = NFOR(features=(), fireflies="limit", **SMALL).instead({"color", "color_variance"})
    assert found is not None
    other, (reason,) = found
    assert isinstance(other, NFOR)
    assert other.fireflies == "keep"
    assert "one bandwidth; its fireflies stay" in reason


def test_what_only_the_user_can_say_is_not_assumed(buffers: dict[str, Tensor]) -> None:
    network = NFOR(features=("albedo",), **SMALL)
    assert network.instead(set(buffers)) is None
    assert network.instead({"color", "albedo"}) is None
    assert network.instead(set(buffers) - {"albedo_a", "albedo_variance"}) is None
    assert NFOR(color_noise="estimated", features=()).instead({"color_a", "color_b"}) is None


def test_fireflies_are_limited_before_anything_else(buffers: dict[str, Tensor]) -> None:
    buffers["color_a"][..., 9, 9] += 50.0
    buffers["color_variance"][..., 9, 9] += 625.0
    names = [f"color_{part}" for part in PARTS]
    limited = dict(zip(names, limited_halves(Halves(*(buffers[n] for n in names))), strict=True))
    assert limited["color_a"].max() < 0.3 * buffers["color_a"].max()
    expected = NFOR(**SMALL)({**buffers, **limited}).color
    assert torch.equal(NFOR(fireflies="limit", **SMALL)(buffers).color, expected)
    assert not torch.equal(NFOR(**SMALL)(buffers).color, expected)


OPTIONS: list[dict[str, Any]] = [
    {"color_noise": "halves", "feature_noise": "halves", "smoothing": 3},
    {"color_noise": "estimated", "feature_noise": "estimated"},
    {"color_noise": "variance", "feature_noise": "none"},
    {"fireflies": "limit", "features": (), "preset": "paper"},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_tiles_with_the_halo_give_the_whole_image(options: dict[str, Any]) -> None:
    network = NFOR(window=1, patch=1, prefilter_window=1, final_window=1, fused=False, **options)
    given = split_buffers(1, 20, 60)
    given["color"] = 0.5 * (given["color_a"] + given["color_b"])
    torch.testing.assert_close(
        denoise_tiled(network, given, tile=16), network(given).color, rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"color_noise": "none"}, "color_noise must be one of measured, halves, variance, estimated, got"),
        ({"feature_noise": "no"}, "feature_noise must be one of measured, .*, none, got 'no'"),
        ({"feature_noise": ["none"]}, "one word, or one for each of the 3 features, got 1"),
        ({"features": ("depth", "depth")}, "features must be different buffers beside color"),
        ({"features": ("color",)}, "features must be different buffers beside color"),
        ({"fireflies": "drop"}, "fireflies must be keep or limit, got 'drop'"),
        ({"fireflies": "limit", "color_noise": "variance"}, "NFOR: fireflies=limit compares two halves"),
        ({"smoothing": -1}, "frames and smoothing must be at least 0, got 0 and -1"),
    ],
)
def test_wrong_options_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NFOR(**arguments)
