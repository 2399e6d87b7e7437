"""RDFC is its transcription in float64, and its parts do what the paper says of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from data.derive import derive
from data.exr import read_frame
from data.root import resolve_root
from models.classical.rdfc import RDFC
from models.ops.nlm import Guide
from models.ops.opposite import FeatureMap, PairKernel, Rule
from models.ops.paired import pair_filter
from models.ops.risk import blurred, chosen_maps, estimated_risk
from tests.models import plain_rdfc
from tests.models.classical.test_nlm_forms import DEVICES, as_rows, color_parts, noisy_buffers
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

SMALL: dict[str, Any] = {"window": 3, "prefilter_window": 2, "selection_window": 2, "second_window": 2}
NUMBERS = plain_rdfc.Numbers(window=3, selection_window=2, second_window=2)
PARTS = ("a", "b", "variance")
NAMES = ("normal", "albedo", "depth")


def doubled(buffers: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: image.double() for name, image in buffers.items()}


def plain_features(buffers: dict[str, Tensor], radius: int, patch: int = 3) -> list[plain_rdfc.Feature]:
    """Return normal, albedo and depth as RDFC normalises and filters them, without its code."""
    found = []
    for name in NAMES:
        a, b, variance = (as_rows(buffers[f"{name}_{part}"]) for part in PARTS)
        unit = 1.0
        if name == "normal":
            a, b, variance = (a + 1) / 2, (b + 1) / 2, variance / 4
        if name == "albedo":
            scale = 1 / np.maximum(1, ((a + b) / 2).max(-1, keepdims=True))
            a, b, variance = a * scale, b * scale, variance * scale**2
        if name == "depth":
            unit = float(((a + b) / 2).max())
        found.append(plain_rdfc.filtered_feature(a, b, variance, radius, unit, patch))
    return found


@pytest.fixture(scope="module")
def buffers() -> dict[str, Tensor]:
    found = noisy_buffers(1, 18, 19)
    for part in "ab":  # a reflectance above 1
        found[f"albedo_{part}"][..., 3:6, 4:8] *= 3
    return found


@pytest.fixture(scope="module")
def features(buffers: dict[str, Tensor]) -> list[plain_rdfc.Feature]:
    return plain_features(doubled(buffers), 2)


@pytest.mark.parametrize("guarded", [True, False])
def test_the_result_its_errors_and_its_selection_equal_the_transcription(
    buffers: dict[str, Tensor], features: list[plain_rdfc.Feature], guarded: bool
) -> None:
    given = plain_rdfc.Numbers(**{**vars(NUMBERS), "guarded": guarded})
    expected = plain_rdfc.rdfc(*color_parts(doubled(buffers)), features, given)
    found = RDFC(**SMALL, guarded=guarded, aux=True)(doubled(buffers))
    assert found.aux is not None
    assert np.abs(as_rows(found.color) - expected.color).max() < 1e-10
    assert np.abs(as_rows(found.aux["shares"]) - expected.shares).max() < 1e-10
    for i, name in enumerate(("first", "second", "third")):
        assert np.abs(as_rows(found.aux[f"error_{name}"])[..., 0] - expected.errors[..., i]).max() < 1e-10
    assert (expected.shares.max((0, 1)) > 0.2).all()  # each is chosen somewhere


@pytest.mark.parametrize(
    "size", [(1, 12), *(pytest.param(size, marks=pytest.mark.slow) for size in ((5, 1), (24, 23)))]
)
def test_published_radii_equal_the_transcription_also_where_windows_are_larger_than_the_image(
    size: tuple[int, int],
) -> None:
    given = doubled(noisy_buffers(1, *size))
    expected = plain_rdfc.rdfc(*color_parts(given), plain_features(given, 5), plain_rdfc.Numbers())
    assert np.abs(as_rows(RDFC()(given).color) - expected.color).max() < 1e-10


def test_a_rendered_still_equals_the_transcription() -> None:
    names = [f"{name}_{part}" for name in ("color", *NAMES) for part in PARTS]
    frame = derive(read_frame(resolve_root("sample:stills").path / "outdoor-000003" / "f000.exr"), names)
    rows, columns = slice(24, 42), slice(80, 98)  # highlights of 17 among shadows of 0.04
    cut = {name: frame.buffers[name][rows, columns].transpose(2, 0, 1) for name in names}
    given = {name: torch.from_numpy(np.ascontiguousarray(array))[None] for name, array in cut.items()}
    numbers = plain_rdfc.Numbers(window=3, selection_window=2, second_window=2)
    expected = plain_rdfc.rdfc(*color_parts(doubled(given)), plain_features(doubled(given), 2), numbers)
    largest = np.abs(expected.color).max()
    assert np.abs(as_rows(RDFC(**SMALL)(doubled(given)).color) - expected.color).max() < 1e-10 * largest
    assert np.abs(as_rows(RDFC(**SMALL)(given).color) - expected.color).max() < 1e-4 * largest


def test_other_patches_of_the_filters_around_the_candidates_equal_the_transcription(
    buffers: dict[str, Tensor],
) -> None:
    given = doubled(buffers)
    numbers = plain_rdfc.Numbers(**{**vars(NUMBERS), "patch": 1})
    expected = plain_rdfc.rdfc(*color_parts(given), plain_features(given, 2, 1), numbers)
    assert np.abs(as_rows(RDFC(**SMALL, patch=1)(given).color) - expected.color).max() < 1e-10


def test_features_without_noise_and_a_colour_without_halves_equal_the_transcription(
    buffers: dict[str, Tensor],
) -> None:
    given = doubled(buffers)
    color, variance, albedo = (as_rows(given[name]) for name in ("color", "color_variance", "albedo"))
    scaled = albedo / np.maximum(1, albedo.max(-1, keepdims=True))
    features = [plain_rdfc.Feature(scaled, np.zeros_like(scaled), 1.0)]
    expected = plain_rdfc.rdfc(color, color, variance, features, NUMBERS)
    method = RDFC(("albedo",), color_noise="variance", feature_noise="none", **SMALL)
    assert method.inputs == ("color", "color_variance", "albedo")
    assert np.abs(as_rows(method(given).color) - expected.mix).max() < 1e-10


@pytest.mark.parametrize("device", DEVICES)
def test_on_every_device_the_result_is_that_of_the_cpu_in_double_precision(device: str) -> None:
    given = noisy_buffers(2, 19, 22)
    expected = RDFC(**SMALL)(doubled(given)).color
    found = RDFC(**SMALL)({name: image.to(device) for name, image in given.items()}).color
    assert largest_relative(expected, given["color"]) > 0.02  # it filters
    assert found.device.type == device
    assert largest_relative(found.cpu(), expected) < 1e-4


def test_in_strips_the_result_is_that_of_the_whole() -> None:
    given = noisy_buffers(1, 61, 18)
    whole = RDFC(window=2)(given).color
    assert largest_relative(RDFC(window=2, memory=1)(given).color, whole) < 1e-6


def test_the_derivative_is_what_the_result_changes_by_when_one_pixel_does() -> None:
    generator = torch.Generator().manual_seed(2)
    color = 1 + 0.3 * torch.rand(1, 3, 15, 15, generator=generator, dtype=torch.float64)
    variance = torch.full_like(color, 0.02)
    kernel = PairKernel(2, (Rule(0),), 0.45)
    still = pair_filter(color, Guide(color, variance), kernel, step=0.01)
    brighter = color.clone()
    brighter[..., 7, 8] *= 1.01
    moved = pair_filter(brighter, Guide(brighter, variance), kernel).images
    change = (moved - still.images)[0, 0, :, 7, 8] / (0.01 * color[0, :, 7, 8])
    assert still.derivative is not None
    assert ((change > 0.02) & (change < 0.98)).all()
    torch.testing.assert_close(still.derivative[0, 0, :, 7, 8], change, rtol=1e-9, atol=0)


def test_the_estimated_risk_of_second_and_third_is_their_squared_error_on_average() -> None:
    generator = torch.Generator().manual_seed(4)
    truth = torch.arange(128.0).mul(0.3).sin().add(2).expand(1, 3, 128, 128)
    noisy = truth + 0.3 * torch.randn(1, 3, 128, 128, generator=generator)
    guide = Guide(noisy, torch.full_like(noisy, 0.09))
    images, derivative = pair_filter(noisy, guide, PairKernel(4, (Rule(3), Rule(None)), 0.45), step=0.01)
    assert derivative is not None
    estimated = estimated_risk(images, guide, derivative).mean((0, 2, 3))
    actual = (images - truth[:, None]).square().mean((0, 2, 3, 4))
    assert actual[1] > 2 * actual[0]
    assert ((estimated - actual).abs() < 0.15 * actual).all()


def test_of_equal_errors_the_later_candidate_is_chosen_and_first_only_with_the_smaller_derivative() -> None:
    errors = torch.tensor([[1.0, 1, 1], [1, 1, 2], [1, 2, 3], [1, 2, 3], [2, 1, 3]]).T[None, :, None]
    slopes = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0.4, 0.4, 0], [0.5, 0.4, 0], [0.1, 0.2, 0]]).T[
        None, :, None
    ]
    assert chosen_maps(errors, slopes).argmax(1).flatten().tolist() == [2, 1, 0, 1, 1]
    assert chosen_maps(errors, None).argmax(1).flatten().tolist() == [2, 1, 0, 0, 1]
    assert (chosen_maps(errors, slopes).sum(1) == 1).all()


def scene(shadow: bool) -> tuple[dict[str, Tensor], Tensor]:
    """Return noisy halves of an edge in the colour, and whether the albedo shows it."""
    generator = torch.Generator().manual_seed(6)
    side = (torch.arange(40) < 20).float().expand(1, 3, 40, 40)
    truth = 0.3 + side
    a, b = (truth + 0.15 * torch.randn(1, 3, 40, 40, generator=generator) for _ in "ab")
    color = {"color_a": a, "color_b": b, "color_variance": torch.full_like(a, 0.15**2 / 2)}
    albedo = torch.full_like(side, 0.5) if shadow else side
    return {**color, "albedo": albedo}, truth


def test_shadows_are_left_to_the_filters_that_see_colour_and_edges_of_features_to_the_third() -> None:
    shares = []
    for shadow in (True, False):
        given, truth = scene(shadow)
        found = RDFC(("albedo",), feature_noise="none", window=5, aux=True)(given)
        assert found.aux is not None
        shares.append(found.aux["shares"][..., 18:22].mean((0, 2, 3)))
        noisy = 0.5 * (given["color_a"] + given["color_b"])
        assert (found.color - truth).square().mean() < 0.1 * (noisy - truth).square().mean()
    assert shares[0][2] < 0.1
    assert shares[1][2] > 0.5


def test_the_second_pass_leaves_less_noise() -> None:
    given, truth = scene(True)
    left = [
        float((RDFC((), window=5, second_pass=again)(given).color - truth).square().mean())
        for again in (True, False)
    ]
    assert left[0] < 0.9 * left[1]


@pytest.mark.parametrize("value", [0.3, 1000.0])
def test_a_constant_image_stays_constant_borders_included(value: float) -> None:
    given = noisy_buffers(1, 17, 19)
    for part in "ab":
        given[f"color_{part}"] = torch.full((1, 3, 17, 19), value)
    found = RDFC(**SMALL)(given).color
    torch.testing.assert_close(found, torch.full_like(found, value), rtol=1e-5, atol=0)


def test_one_lit_pixel_without_noise_stays_but_where_colour_is_not_looked_at() -> None:
    image = torch.zeros(1, 3, 17, 19)
    image[..., 8, 9] = 5.0
    kernel = PairKernel(3, (Rule(1), Rule(3), Rule(None)), 0.45)
    found = pair_filter(image, Guide(image, torch.zeros_like(image)), kernel).images
    assert torch.equal(found[:, 0], image)
    assert torch.equal(found[:, 1], image)
    expected = torch.zeros_like(image)
    expected[..., 5:12, 6:13] = 5 / 49
    torch.testing.assert_close(found[:, 2], expected)


def test_opposite_neighbours_are_compared_together_only_where_both_distances_are_below_25() -> None:
    """Along a ramp of steps s both are (s^2 - 0.1) / 0.4: 22 and 40; that to their mean is below 0."""
    found = {}
    for step in (3.0, 4.0):
        color = (step * torch.arange(31.0, dtype=torch.float64)).expand(1, 1, 3, 31)
        guide = Guide(color, torch.full_like(color, 0.05))
        image = torch.zeros_like(color)
        image[..., 15] = 1.0  # how much of it arrives beside it
        weights = pair_filter(image, guide, PairKernel(1, (Rule(0),), 2.0)).images[0, 0, 0, 1]
        found[step] = float(weights[16] / weights[15])
    assert found[3.0] == pytest.approx(1.0)
    assert found[4.0] == pytest.approx(np.exp(-15.9 / 0.4))


def test_the_blur_keeps_the_mean_of_constants_and_spreads_an_impulse_by_gaussian_taps() -> None:
    ones = torch.ones(1, 1, 1, 4)
    torch.testing.assert_close(blurred(ones), ones)
    impulse = torch.zeros(1, 1, 5, 5, dtype=torch.float64)
    impulse[..., 2, 2] = 1.0
    found = blurred(impulse)[0, 0]
    assert float(found[2, 2]) == pytest.approx((1 / (1 + 2 * np.exp(-2))) ** 2)
    assert float(found[2, 1] / found[2, 2]) == pytest.approx(0.1353, rel=1e-3)
    assert float(found[1, 1] / found[2, 2]) == pytest.approx(0.1353**2, rel=1e-3)


def test_tau_of_distances_is_in_units_of_the_largest_of_the_frame() -> None:
    image = torch.zeros(1, 1, 4, 4)
    unit = torch.full((1, 1, 1, 1), 7.0)
    found = FeatureMap(image, image, unit).spread(1e-3)
    torch.testing.assert_close(found, torch.full_like(image, 1e-3 * 49))
