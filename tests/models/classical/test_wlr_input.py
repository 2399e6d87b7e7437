"""WLR with other inputs than a mean and a variance, with damaged ones, and what it refuses."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from models.classical.wlr import WLR
from models.ops.halves import estimated_variance, halves_variance
from tests.models.frames import largest_relative, split_buffers

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAMES = ("depth", "normal", "albedo")


@pytest.fixture
def buffers() -> dict[str, Tensor]:
    found = split_buffers(1, 16, 18)
    found["color"] = 0.5 * (found["color_a"] + found["color_b"])
    return found


def read(network: WLR, buffers: dict[str, Tensor]) -> Tensor:
    """Denoise with nothing but what it says that it reads."""
    return network({name: buffers[name] for name in network.inputs}).color


def test_halves_give_what_their_mean_and_smoothed_difference_give(buffers: dict[str, Tensor]) -> None:
    network = WLR(window=2, color_noise="halves", feature_noise="halves", smoothing=2)
    for name in ("color", *NAMES):
        a, b = buffers[f"{name}_a"], buffers[f"{name}_b"]
        buffers |= {name: 0.5 * (a + b), f"{name}_variance": halves_variance(a, b, 2)}
    assert largest_relative(read(network, buffers), read(WLR(window=2), buffers)) < 1e-6


def test_the_image_alone_gives_what_its_estimated_variance_gives(buffers: dict[str, Tensor]) -> None:
    found = read(WLR((), window=2, color_noise="estimated"), buffers)
    buffers["color_variance"] = estimated_variance(buffers["color"])
    assert largest_relative(found, read(WLR((), window=2), buffers)) < 1e-6


def test_features_without_noise_have_no_variance(buffers: dict[str, Tensor]) -> None:
    found = read(WLR(window=2, feature_noise=["none", "variance", "none"]), buffers)
    for name in ("depth", "albedo"):
        buffers[f"{name}_variance"] = torch.zeros_like(buffers[name])
    assert torch.equal(found, read(WLR(window=2), buffers))


def test_fireflies_are_limited_before_the_fit(buffers: dict[str, Tensor]) -> None:
    buffers["color_a"][..., 8, 8] += 80.0
    buffers["color_variance"][..., 8, 8] += 400.0
    kept = read(WLR(window=2, color_noise="measured"), buffers)
    limited = read(WLR(window=2, color_noise="measured", fireflies="limit"), buffers)
    assert limited[..., 8, 8].max() < 10 < kept[..., 8, 8].max()


@pytest.mark.parametrize(
    ("lacking", "color", "features", "said"),
    [
        ({"color_variance"}, "halves", ["variance"] * 2, ["no color_variance"]),
        ({"normal"}, "variance", ["halves", "variance"], ["no normal:"]),
        ({"color", "depth_variance"}, "halves", ["variance", "halves"], ["no color:", "no depth_variance"]),
    ],
)
def test_what_lacks_is_done_without_and_said(
    buffers: dict[str, Tensor], lacking: set[str], color: str, features: list[str], said: list[str]
) -> None:
    found = WLR(("normal", "depth"), window=2, aux=True, trials=(0.3, 0.9)).instead(set(buffers) - lacking)
    assert found is not None
    other, reasons = found
    assert isinstance(other, WLR)
    assert list(other.noises.values()) == [color, *features]
    assert (other.aux, other.rule.window, other.rule.trials) == (True, 2, (0.3, 0.9))
    assert len(reasons) == len(said)
    assert all(part in reason for part, reason in zip(said, reasons, strict=True))
    assert not set(other.inputs) & lacking
    assert read(other, buffers).isfinite().all()


def test_prefiltering_asks_for_halves_and_does_without(buffers: dict[str, Tensor]) -> None:
    network = WLR(("albedo",), prefilter=True, window=2, patch=1, prefilter_window=1, final_window=1)
    assert network.inputs[2:] == ("albedo_a", "albedo_b", "albedo_variance")
    found = network.instead({"color", "color_variance", "albedo", "albedo_variance"})
    assert found is not None
    assert found[0].inputs[2:] == ("albedo", "albedo_variance")
    assert "no albedo_a and no albedo_b" in found[1][0]
    changed = found[0]({name: buffers[name] for name in found[0].inputs}).color
    assert not changed.allclose(WLR(("albedo",), window=2)(buffers).color)


def test_what_only_the_user_can_say_is_not_assumed(buffers: dict[str, Tensor]) -> None:
    assert WLR(("albedo",)).instead(set(buffers)) is None
    assert WLR(("albedo",)).instead({"color", "albedo"}) is None
    limited = WLR((), color_noise="measured", fireflies="limit").instead({"color", "color_variance"})
    assert limited is not None
    assert "its fireflies stay" in limited[1][0]


def test_missing_buffers_are_named_with_what_makes_them(buffers: dict[str, Tensor]) -> None:
    del buffers["color_variance"], buffers["normal_variance"]
    expected = (
        r"missing: color_variance, normal_variance; .*`trainer render stills` writes halves and variances; "
        r"color_noise=estimated needs color alone"
    )
    with pytest.raises(ValueError, match=expected):
        WLR()(buffers)


@pytest.mark.parametrize("fused", [False, True])
def test_damaged_pixels_do_not_spread_and_are_filled(buffers: dict[str, Tensor], fused: bool) -> None:
    network = WLR(window=2, fused=fused)
    holes = {name: x.clone() for name, x in buffers.items()}
    holes["color"][..., 8, 8] = torch.nan
    holes["color"][:, 1, 3, 12] = torch.inf
    holes["color_variance"][..., 12, 3] = torch.nan
    holes["albedo"][..., 5, 5] = torch.nan
    damaged = [(8, 8), (3, 12), (12, 3), (5, 5)]
    found = read(network, holes)
    assert found.isfinite().all()
    other = {name: x.clone() for name, x in holes.items()}
    for y, x in damaged:
        other["color"][..., y, x] = torch.nan
        other["color_variance"][..., y, x] = 7.0
    torch.testing.assert_close(read(network, other), found, rtol=1e-6, atol=0)
    around = buffers["color"][..., 6:11, 6:11]
    assert (found[..., 8, 8] >= around.amin((-1, -2))).all()
    assert (found[..., 8, 8] <= around.amax((-1, -2))).all()


@pytest.mark.parametrize("fused", [False, True])
def test_an_image_of_nothing_but_damage_is_black(buffers: dict[str, Tensor], fused: bool) -> None:
    holes = {name: torch.full_like(x, torch.nan) for name, x in buffers.items()}
    assert (read(WLR(window=2, fused=fused), holes) == 0).all()


def test_compiled_kernels_fill_damaged_pixels_like_the_others(buffers: dict[str, Tensor]) -> None:
    buffers["color"][..., 8, 8] = torch.nan
    buffers["color_variance"][..., 12, 3] = torch.nan
    buffers["albedo"][..., 5, 5] = torch.inf
    wide = {name: x.double() for name, x in buffers.items()}
    found = read(WLR(window=2, fused=True), wide)
    torch.testing.assert_close(found, read(WLR(window=2, fused=False), wide), rtol=1e-9, atol=1e-12)


def test_a_variance_that_is_not_a_number_counts_as_the_limit(buffers: dict[str, Tensor]) -> None:
    buffers["albedo_variance"][..., 4:9, :] = torch.nan
    found = read(WLR(window=2), buffers)
    buffers["albedo_variance"] = buffers["albedo_variance"].nan_to_num(1.0)
    assert torch.equal(found, read(WLR(window=2), buffers))


@pytest.mark.parametrize("size", [(20, 1), (1, 20), (1, 1), (2, 2)])
@pytest.mark.parametrize("prefilter", [False, True])
def test_images_of_one_pixel_across_are_denoised(size: tuple[int, int], prefilter: bool) -> None:
    network = WLR(window=3, prefilter=prefilter, patch=1, prefilter_window=1, final_window=1)
    given = split_buffers(1, *size)
    given["color_variance"] = given["color"].square()
    found = read(network, given)
    assert found.shape == (1, 3, *size)
    assert found.isfinite().all()
    if size == (1, 1):
        torch.testing.assert_close(found, given["color"])


def test_gradients_are_finite_where_features_are_constant(buffers: dict[str, Tensor]) -> None:
    names = ("color", "color_variance", *NAMES)
    for name in NAMES:
        buffers[name] = torch.full_like(buffers[name], 0.5)
    with torch.enable_grad():
        for name in names:
            buffers[name].requires_grad_()
        read(WLR(window=2), buffers).square().sum().backward()
    gradients = [buffers[name].grad for name in names]
    assert all(g is None or g.isfinite().all() for g in gradients)
    assert gradients[0] is not None
    assert gradients[0].abs().max() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"window": 0}, "window radius of at least 1, got 0"),
        ({"trials": (0.5,)}, r"at least two bandwidths > 0 to try, got \(0.5,\)"),
        ({"trials": (0.0, 0.5)}, "at least two bandwidths > 0"),
        ({"least_bandwidth": 0.0}, "least_bandwidth must be above 0 and at most 1, got 0.0"),
        ({"ridge": 0.0}, "ridge must be positive, got 0.0"),
        ({"least_curvature": float("nan")}, "least_curvature must be positive, got nan"),
        ({"map_sigma": -1.0}, "map_sigma must be at least 0, got -1.0"),
        ({"variance_limit": -1.0}, "smoothing and variance_limit must be at least 0, got 1 and -1.0"),
        ({"color_noise": "none"}, "WLR: color_noise must be one of measured, halves, variance, estimated"),
        ({"features": ("gloss",)}, "unknown buffer 'gloss'"),
        ({"features": ("color",)}, "WLR: features must be different buffers beside color"),
        ({"fireflies": "limit"}, "WLR: fireflies=limit compares two halves"),
    ],
)
def test_wrong_options_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WLR(**arguments)


def test_layers_are_returned_when_asked_for(buffers: dict[str, Tensor]) -> None:
    network = WLR(window=2, aux=True)
    found, details = network(buffers).aux, network.details(buffers)
    assert WLR(window=2)(buffers).aux is None
    assert found is not None
    assert set(found) == {"bandwidth", "directions"}
    assert torch.equal(found["bandwidth"], details.bandwidth)
    assert torch.equal(found["directions"], details.rank / 9)
    assert torch.equal(details.features["albedo"], buffers["albedo"])
