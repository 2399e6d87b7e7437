"""RDFC with other inputs than two halves and a measured variance, in tiles, and on damaged frames."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from models.classical.rdfc import RDFC
from models.denoiser import select
from models.ops.symmetric import scaled_variance
from models.tiling import denoise_tiled
from tests.models.classical.test_nlm_forms import noisy_buffers
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

SMALL: dict[str, Any] = {"window": 2, "patches": (0, 1), "prefilter_window": 1, "selection_window": 1}
PARTS = ("a", "b", "variance")


@pytest.fixture
def buffers() -> dict[str, Tensor]:
    return noisy_buffers(1, 20, 24)


OPTIONS: list[dict[str, Any]] = [
    {},
    {"color_noise": "halves", "feature_noise": "halves"},
    {"color_noise": "estimated", "feature_noise": "none"},
    {"color_noise": "variance", "feature_noise": "estimated"},
    {"features": ("albedo",), "sampling": "low-discrepancy", "fireflies": "limit", "second_window": 3},
    {"features": (), "second_pass": False, "guarded": False},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_tiles_with_the_halo_give_the_whole_image(options: dict[str, Any]) -> None:
    method = RDFC(**SMALL, **options)
    given = noisy_buffers(1, 61, 75)
    read = select(method, given)
    assert largest_relative(denoise_tiled(method, read, tile=16), method(read).color) < 1e-5


def test_the_largest_depth_is_that_of_the_whole_frame(buffers: dict[str, Tensor]) -> None:
    method = RDFC(("depth",), **SMALL)
    found = method.measure(buffers)["depth_range"]
    mean = 0.5 * (buffers["depth_a"] + buffers["depth_b"])
    assert float(found[0, 1]) == float(mean.max())
    assert torch.equal(method({**buffers, "depth_range": found}).color, method(buffers).color)
    far = torch.tensor([[0.0, 1e4]])
    assert not torch.equal(method({**buffers, "depth_range": far}).color, method(buffers).color)
    assert RDFC(("albedo",)).measure(buffers) == {}
    assert RDFC(("albedo",)).frame_numbers == ("exposure",)


def test_with_positions_images_are_not_cut(buffers: dict[str, Tensor]) -> None:
    for part in ("", "_a", "_b", "_variance"):
        buffers[f"position{part}"] = buffers[f"depth{part}"].expand(1, 3, -1, -1)
    method = RDFC(("position",), **SMALL)
    assert method.whole
    assert not RDFC().whole
    expected = RDFC(("depth",), **SMALL)(buffers).color
    assert largest_relative(method(buffers).color, expected) < 1e-5  # three times the same


def test_low_discrepancy_variances_are_scaled_of_colour_and_features(buffers: dict[str, Tensor]) -> None:
    scaled = dict(buffers)
    for name in ("color", "normal", "albedo", "depth"):
        a, b, variance = (buffers[f"{name}_{part}"] for part in PARTS)
        scaled[f"{name}_variance"] = scaled_variance(variance, a, b, 10)
    expected = RDFC(**SMALL)(scaled).color
    found = RDFC(sampling="low-discrepancy", **SMALL)(buffers).color
    assert largest_relative(found, expected) < 1e-6
    assert largest_relative(RDFC(**SMALL)(buffers).color, expected) > 1e-4


def test_units_of_radiance_do_not_matter_where_the_exposure_says_them(buffers: dict[str, Tensor]) -> None:
    bright = {
        n: x * (50 if n != "color_variance" else 2500) if "color" in n else x for n, x in buffers.items()
    }
    found = RDFC(aux=True, **SMALL)({**bright, "exposure": torch.tensor([1 / 50])})
    expected = RDFC(aux=True, **SMALL)(buffers)
    assert largest_relative(found.color / 50, expected.color) < 1e-5
    assert found.aux is not None
    assert expected.aux is not None
    assert largest_relative(found.aux["error_second"] / 2500, expected.aux["error_second"]) < 1e-4


def test_layers_are_returned_when_asked_for(buffers: dict[str, Tensor]) -> None:
    assert RDFC(**SMALL)(buffers).aux is None
    found = RDFC(("normal", "albedo"), feature_noise="none", aux=True, **SMALL)(buffers).aux
    assert found is not None
    assert set(found) == {"shares", "error_first", "error_second", "error_third", "normal", "albedo"}
    torch.testing.assert_close(found["normal"], buffers["normal"], rtol=0, atol=1e-6)
    torch.testing.assert_close(found["shares"].sum(1), torch.ones(1, 20, 24))
    assert found["error_third"].shape == (1, 1, 20, 24)


def test_what_lacks_is_done_without_and_said(buffers: dict[str, Tensor]) -> None:
    method = RDFC(("albedo", "depth"), fireflies="limit", sampling="low-discrepancy", **SMALL)
    assert method.instead(set(buffers)) is None
    assert method.instead({"color"}) is None
    available = set(buffers) - {"color_a", "color_b", "depth_variance"}
    found = method.instead(available)
    assert found is not None
    other, reasons = found
    assert isinstance(other, RDFC)
    assert other.noises == {"color": "variance", "albedo": "measured", "depth": "halves"}
    assert (other.fireflies, other.sampling) == ("keep", "low-discrepancy")
    assert len(reasons) == 2
    assert "no second pass; its fireflies stay" in reasons[0]
    assert "no depth_variance" in reasons[1]
    assert other(select(other, buffers)).color.isfinite().all()


def test_a_frame_of_one_buffer_is_refused_with_what_makes_the_others(buffers: dict[str, Tensor]) -> None:
    with pytest.raises(ValueError, match=r"missing: color_a.*`trainer render stills` writes halves") as error:
        RDFC()({"color": buffers["color"]})
    assert "color_noise=estimated needs color alone" in str(error.value)
    assert "feature_noise=none takes features as they are" in str(error.value)
    with pytest.raises(ValueError, match="buffer 'depth_variance' has shape"):
        RDFC()({**buffers, "depth_variance": torch.zeros(1, 3, 20, 24)})


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e30, 65504.0, -3.0])
def test_damaged_pixels_spoil_nothing_but_themselves(value: float) -> None:
    buffers = noisy_buffers(1, 40, 24)
    broken = {name: image.clone() for name, image in buffers.items()}
    for name in RDFC().inputs:
        broken[name][..., 3, 4] = value
    method = RDFC(("normal", "albedo"), **SMALL)
    found = method(select(method, broken)).color
    assert found.isfinite().all()
    far = slice(3 + method.halo + 1, None)
    assert largest_relative(found[..., far, :], method(buffers).color[..., far, :]) < 1e-6


@pytest.mark.parametrize("size", [(1, 1), (1, 20), (20, 1), (2, 3)])
def test_tiny_images_are_filtered(size: tuple[int, int]) -> None:
    given = noisy_buffers(1, *size)
    color = RDFC(window=3)(given).color
    assert color.shape == (1, 3, *size)
    assert color.isfinite().all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"patches": (1, 2, 3)}, "RDFC: expected two radii as patches"),
        ({"step": 0.0}, "and a step > 0"),
        ({"window": 0}, "window radius >= 1"),
        ({"patches": (-1, 3)}, "got 10, -1, 3 and 0"),
        ({"bandwidth": 0.0}, "bandwidths must be positive, got 0.0 and 0.6"),
        ({"third_tau": -1.0}, "tau must be at least 0, got 0.001, -1.0"),
        ({"color_noise": "none"}, "RDFC: color_noise must be one of measured, halves, variance, estimated"),
        ({"features": ("depth", "depth")}, "RDFC: features must be different buffers beside color"),
        ({"feature_noise": ["none"]}, "RDFC: feature_noise must be one word, or one for each of the 3"),
        ({"sampling": "sobol"}, "RDFC: sampling must be random or low-discrepancy"),
        (
            {"sampling": "low-discrepancy", "color_noise": "halves", "feature_noise": "none"},
            "corrects measured variances, and none is read",
        ),
        ({"fireflies": "limit", "color_noise": "variance"}, "RDFC: fireflies=limit compares two halves"),
    ],
)
def test_impossible_options_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RDFC(**arguments)
