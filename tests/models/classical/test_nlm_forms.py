"""Every form of non-local means equals its transcription in float64, on every device."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import models
from models import NLM, CrossBilateral, JointNLM, MultiScaleNLM
from models.denoiser import Denoiser, select
from models.ops.symmetric import residual_error, scaled_variance
from models.tiling import denoise_tiled
from tests.models import plain_nlm, plain_pyramid
from tests.models.frames import largest_relative, split_buffers
from tests.models.plain_nlm import Array

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]

CLASSICAL: list[Denoiser] = [
    NLM(3, 1),
    NLM(3, 1, preset="rkz12"),
    NLM(3, 1, sampling="low-discrepancy", fireflies="limit", aux=True),
    NLM(3, 1, color_noise="estimated"),
    JointNLM(window=3, patch=1),
    JointNLM(combine="product", window=3, patch=1, color_noise="halves", feature_noise="variance"),
    MultiScaleNLM(3, 2, 1),
    CrossBilateral(3),
    models.JointBilateral(3),
    models.NFOR(window=2, patch=1, prefilter_window=2, final_window=1),
    models.NFOR("paper", window=2, patch=1, prefilter_window=2, final_window=1),
]
"""Every classical method, its presets and inputs, with narrow windows."""


def noisy_buffers(batch: int, height: int, width: int) -> dict[str, Tensor]:
    """Return buffers with halves whose noise their variances tell, so that weights take all values."""
    buffers = split_buffers(batch, height, width)
    generator = torch.Generator().manual_seed(5)
    for name in ("color", "albedo", "normal", "depth"):
        smooth = torch.nn.functional.avg_pool2d(buffers[name], 7, 1, 3, count_include_pad=False)
        level = (0.4 if name == "color" else 0.1) * smooth.abs().mean()
        a, b = (smooth + level * torch.randn(smooth.shape, generator=generator) for _ in "ab")
        if name == "color":
            a, b = a.clamp_min(0), b.clamp_min(0)
        spread = 0.5 + torch.rand(smooth.shape, generator=generator)
        parts = {"": 0.5 * (a + b), "_a": a, "_b": b, "_variance": 0.5 * level**2 * spread}
        buffers |= {f"{name}{part}": image for part, image in parts.items()}
    return buffers


def as_rows(image: Tensor) -> Array:
    return np.asarray(image[0].permute(1, 2, 0).double().numpy())


def color_parts(buffers: dict[str, Tensor]) -> tuple[Array, Array, Array]:
    a, b, variance = (as_rows(buffers[f"color_{part}"]) for part in ("a", "b", "variance"))
    return a, b, variance


def plain_filter(image: Array, guide: Array, variance: Array, window: int = 3, patch: int = 1) -> Array:
    """Filter with the weights of a half, whose variance is twice that of the mean."""
    return plain_nlm.joint(image, (guide, 2 * variance), [], (window, patch, 0.45, 1.0), False)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", CLASSICAL, ids=lambda m: type(m).__name__)
def test_on_every_device_the_result_is_that_of_the_cpu_in_double_precision(
    method: Denoiser, device: str
) -> None:
    buffers = select(method, noisy_buffers(2, 19, 22))
    expected = method({name: image.double() for name, image in buffers.items()}).color
    found = method({name: image.to(device) for name, image in buffers.items()}).color
    if "color" in buffers or "color_a" in buffers:
        noisy = buffers["color"] if "color" in buffers else 0.5 * (buffers["color_a"] + buffers["color_b"])
        assert largest_relative(expected, noisy) > 0.02  # it filters
    assert found.device.type == device
    # float32 against float64: a regression solves nearly singular windows.
    assert largest_relative(found.cpu(), expected) < (1e-3 if isinstance(method, models.NFOR) else 1e-4)


@pytest.mark.parametrize("method", CLASSICAL[:7], ids=lambda m: type(m).__name__)
def test_with_any_option_tiled_equals_untiled(method: Denoiser) -> None:
    buffers = select(method, noisy_buffers(1, 61, 75))
    assert largest_relative(denoise_tiled(method, buffers, tile=32), method(buffers).color) < 1e-5


@pytest.mark.parametrize("symmetric", [True, False])
def test_preset_rkz12_equals_the_transcription(symmetric: bool) -> None:
    buffers = noisy_buffers(1, 24, 24)
    a, b, variance = color_parts(buffers)
    expected = 0.5 * sum(
        plain_nlm.rkz12(image, guide, 2 * variance, 2, 3, 0.45, symmetric)
        for image, guide in ((a, b), (b, a))
    )
    method = NLM(3, 2, preset="rkz12", symmetric=symmetric)
    exact = method({name: image.double() for name, image in buffers.items()}).color
    assert np.abs(as_rows(exact) - expected).max() < 1e-10
    # In float32 a weight of 0.05 may fall on either side.
    assert np.abs(as_rows(method(buffers).color) - expected).max() < 1e-3


def test_rkz12_in_strips_equals_the_whole_and_tiny_images_are_mirrored_more_than_once() -> None:
    buffers = noisy_buffers(1, 61, 18)
    whole = NLM(3, 2, preset="rkz12")(buffers).color
    assert torch.equal(NLM(3, 2, preset="rkz12", memory=1)(buffers).color, whole)
    small = noisy_buffers(1, 3, 4)
    a, b, variance = color_parts(small)
    expected = 0.5 * sum(plain_nlm.rkz12(x, y, 2 * variance, 1, 5, 0.45) for x, y in ((a, b), (b, a)))
    found = NLM(5, 1, preset="rkz12")({name: image.double() for name, image in small.items()}).color
    assert np.abs(as_rows(found) - expected).max() < 1e-10


def test_a_steep_gradient_is_smoothed_only_where_opposite_neighbours_are_compared_together() -> None:
    generator = torch.Generator().manual_seed(0)
    ramp = torch.arange(40.0).expand(1, 3, 24, 40)
    a, b = (ramp + 0.2 * torch.randn(1, 3, 24, 40, generator=generator) for _ in "ab")
    buffers = {"color_a": a, "color_b": b, "color_variance": torch.full_like(a, 0.02)}
    inner = (..., slice(6, -6), slice(8, -8))
    left = [
        float((NLM(3, 1, preset="rkz12", symmetric=s)(buffers).color - ramp)[inner].square().mean())
        for s in (True, False)
    ]
    assert left[0] < 0.5 * left[1]


@pytest.mark.parametrize("combine", ["least", "product"])
def test_compiled_joint_weights_equal_pytorch_on_images_of_many_tiles(combine: str) -> None:
    buffers = noisy_buffers(2, 35, 270)
    found, expected = (
        JointNLM(combine=combine, window=2, patch=1, prefilter_window=1, fused=fused)(buffers).color  # type: ignore[arg-type]
        for fused in (True, False)
    )
    assert largest_relative(found, expected) < 1e-5


@pytest.mark.parametrize("combine", ["least", "product"])
def test_joint_weights_equal_the_transcription(combine: str) -> None:
    buffers = noisy_buffers(1, 24, 23)
    a, b, variance = color_parts(buffers)
    features: list[tuple[Array, Array, Array | float]] = []
    for name in ("normal", "albedo", "depth"):
        x, y, v = (as_rows(buffers[f"{name}_{part}"]) for part in ("a", "b", "variance"))
        filtered = [plain_nlm.nlm(p, q, v, 3, 2, 0.5, 2) for p, q in ((x, y), (y, x))]
        mean, residual = (filtered[0] + filtered[1]) / 2, (filtered[1] - filtered[0]) ** 2 / 4
        features.append((mean, residual, 1e-3 * mean**2 if name == "depth" else 1e-3))
    expected = 0.5 * sum(
        plain_nlm.joint(image, (guide, 2 * variance), features, (3, 3, 0.45, 0.6), combine == "product")
        for image, guide in ((a, b), (b, a))
    )
    method = JointNLM(combine=combine, window=3, prefilter_window=2)  # type: ignore[arg-type]
    exact = method({name: image.double() for name, image in buffers.items()}).color
    assert np.abs(as_rows(exact) - expected).max() < 1e-10
    assert np.abs(as_rows(method(buffers).color) - expected).max() < 1e-4


@pytest.mark.parametrize(("scales", "height", "width"), [(2, 24, 24), (3, 21, 18), (3, 7, 1), (3, 2, 3)])
def test_multiple_scales_equal_the_transcription_at_any_size(scales: int, height: int, width: int) -> None:
    buffers = noisy_buffers(1, height, width)
    a, b, variance = color_parts(buffers)
    expected = plain_pyramid.multi_scale((a, b), variance, scales, plain_filter)
    method = MultiScaleNLM(scales, 3, 1)
    exact = method({name: image.double() for name, image in buffers.items()}).color
    assert np.abs(as_rows(exact) - expected).max() < 1e-10
    assert np.abs(as_rows(method(buffers).color) - expected).max() < 1e-5


@pytest.mark.parametrize("size", [(1, 1), (1, 20), (20, 1)])
def test_images_of_one_pixel_across_are_filtered(size: tuple[int, int]) -> None:
    buffers = noisy_buffers(1, *size)
    for method in (NLM(2), NLM(2, preset="rkz12"), JointNLM(window=2), MultiScaleNLM(3, 2), CrossBilateral()):
        color = method(buffers).color
        assert color.shape == (1, 3, *size)
        assert color.isfinite().all()


@pytest.mark.parametrize("smoothing", [0.0, 0.7, 1.0])
def test_the_bilateral_filter_compares_smoothed_logarithms(smoothing: float) -> None:
    color = noisy_buffers(1, 24, 24)["color"]
    expected = plain_pyramid.bilateral(as_rows(color), 2, 1.5, 0.3, smoothing)
    found = CrossBilateral(2, 1.5, 0.3, smoothing)({"color": color}).color
    assert np.abs(as_rows(found) - expected).max() < 1e-5


def test_low_discrepancy_variance_has_the_mean_of_the_halves_and_the_shape_of_the_samples() -> None:
    generator = torch.Generator().manual_seed(3)
    spread = 0.1 + torch.rand(1, 3, 1, 1, generator=generator).expand(1, 3, 48, 48)
    a, b = (1 + spread * torch.randn(1, 3, 48, 48, generator=generator) for _ in "ab")
    measured = 4 * 0.5 * spread.square()  # of independent samples, four times too large here
    found = scaled_variance(measured, a, b)
    assert abs(float(found.mean() / (0.5 * spread.square()).mean()) - 1) < 0.1
    place = (0, 1, 20, 30)
    box = (0, 1, slice(10, 31), slice(20, 41))
    expected = measured[place] * (0.25 * (a - b)[box].square()).mean() / (1e-10 + measured[box].mean())
    torch.testing.assert_close(found[place], expected, rtol=1e-5, atol=0)


def test_the_residual_error_is_the_smoothed_relative_difference_of_the_halves() -> None:
    a, b = noisy_buffers(1, 9, 12)["color_a"].double(), noisy_buffers(1, 9, 12)["color_b"].double()
    error = (2 * (a - b) ** 2 / (1e-3 + a**2)).mean(1)[0]
    found = residual_error(a, b)[0, 0]
    for y, x in ((0, 0), (4, 6), (8, 11)):
        total, norm = 0.0, 0.0
        for v in range(max(0, y - 3), min(9, y + 4)):
            for u in range(max(0, x - 3), min(12, x + 4)):
                share = float(np.exp(-((v - y) ** 2 + (u - x) ** 2) / (2 * 0.8**2)))
                total, norm = total + share * float(error[v, u]), norm + share
        assert abs(float(found[y, x]) - total / norm) < 1e-9 * total / norm
    aux = NLM(2, 1, aux=True)(noisy_buffers(1, 9, 12)).aux
    assert aux is not None
    assert aux["residual"].shape == (1, 1, 9, 12)


def test_what_a_frame_lacks_is_replaced_feature_by_feature_and_said() -> None:
    names = [f"{n}_{p}" for n in ("color", "albedo") for p in ("a", "b", "variance")]
    method = JointNLM(("normal", "albedo"), window=7)
    assert method.instead([*names, *(f"normal_{p}" for p in ("a", "b", "variance"))]) is None
    found = method.instead([*names, "normal", "normal_variance"])
    assert found is not None
    other, reasons = found
    assert isinstance(other, JointNLM)
    assert other.noises == {"normal": "variance", "albedo": "measured"}
    assert other.kernel.window == 7
    assert len(reasons) == 1
    assert "normal" in reasons[0]
    assert NLM().instead(["color"]) is None


def test_a_frame_of_one_buffer_is_refused_with_the_options_that_take_it() -> None:
    color = noisy_buffers(1, 16, 16)["color"]
    with pytest.raises(ValueError, match=r"missing: color_a.*color_noise=estimated needs color alone"):
        NLM()({"color": color})
    with pytest.raises(ValueError, match="feature_noise=none takes features as they are"):
        JointNLM()({"color": color})
    assert NLM(color_noise="estimated")({"color": color}).color.isfinite().all()


def test_features_without_noise_are_used_as_they_are() -> None:
    buffers = noisy_buffers(1, 16, 16)
    found = JointNLM(("albedo",), window=2, feature_noise="none", aux=True)(buffers)
    assert found.aux is not None
    assert torch.equal(found.aux["albedo"], buffers["albedo"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "other"}, "NLM: preset must be plain or rkz12"),
        ({"sampling": "sobol"}, "NLM: sampling must be random or low-discrepancy"),
        ({"sampling": "low-discrepancy", "color_noise": "halves"}, "needs no correction"),
        ({"color_noise": "none"}, "NLM: color_noise must be one of measured"),
        ({"fireflies": "drop"}, "NLM: fireflies must be keep or limit"),
        ({"fireflies": "limit", "color_noise": "estimated"}, "NLM: fireflies=limit compares two halves"),
        ({"preset": "rkz12", "smoothing": -1}, "smooths weights must be at least 0"),
        ({"preset": "rkz12", "least_weight": 1.0}, r"must be in \[0, 1\)"),
    ],
)
def test_impossible_options_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NLM(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("features", "noise", "message"),
    [
        (("normal", "normal"), "measured", "JointNLM: features must be different buffers beside color"),
        (("color",), "measured", "JointNLM: features must be different buffers beside color"),
        (("foo",), "measured", "foo"),
        (("normal", "depth"), ["none"], "JointNLM: feature_noise must be one word, or one for each of the 2"),
    ],
)
def test_impossible_features_are_refused(features: tuple[str, ...], noise: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        JointNLM(features, feature_noise=noise)  # type: ignore[arg-type]


def test_corrections_that_need_two_halves_are_dropped_and_that_is_said() -> None:
    found = NLM(sampling="low-discrepancy", fireflies="limit").instead({"color", "color_variance"})
    assert found is not None
    other, (reason,) = found
    assert isinstance(other, NLM)
    assert (other.color_noise, other.sampling, other.fireflies) == ("variance", "random", "keep")
    assert "its variance is that of random samples" in reason
    assert "its fireflies stay" in reason
