"""Ray histogram fusion is its formula, at every scale, in every strip, and for broken input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from models import RHF
from models.denoiser import Buffers
from models.ops.histogram import coarser_histogram, histogram_filter
from models.ops.histogram_distance import HistogramKernel
from models.ops.pyramid import coarser
from tests.models import plain_rhf
from tests.models.frames import histogram_of, largest_relative

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")


def noisy(height: int, width: int, spp: int = 8, seed: int = 0) -> Tensor:
    """Samples (S, 3, H, W) of tiles of two brightnesses, float64."""
    generator = torch.Generator().manual_seed(seed)
    bright = (torch.arange(width) // 5 + torch.arange(height)[:, None] // 4) % 2
    light = -torch.rand(spp, 3, height, width, generator=generator, dtype=torch.float64).log()
    return light * (0.2 + 1.5 * bright) * torch.tensor([1.0, 0.7, 0.4])[:, None, None]


def buffers_of(samples: Tensor) -> dict[str, Tensor]:
    return {"color": samples.mean(0)[None], "histogram": histogram_of(samples[None])}


def rows_of(image: Tensor) -> plain_rhf.Array:
    return np.asarray(image[0].permute(1, 2, 0).double().numpy())


def plain(buffers: Buffers, *options: float) -> plain_rhf.Array:
    histogram = rows_of(buffers["histogram"])
    split = histogram.reshape(*histogram.shape[:2], 3, -1)
    return plain_rhf.rhf(rows_of(buffers["color"]), split, *options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [(1, 3, 1, 0.8, 2), (2, 2, 1, 0.8, 2), (3, 1, 1, 0.7, 1), (1, 2, 2, 0.5, 0), (1, 2, 0, 0.3, 3)],
    ids=["one scale", "two scales", "three scales", "patches of 5x5", "single pixels"],
)
def test_the_result_is_the_literal_formula(options: tuple[int, int, int, float, int]) -> None:
    buffers = buffers_of(noisy(13, 11))
    scales, window, patch, threshold, nearest = options
    expected = plain(buffers, *options)
    exact = RHF(scales, window, patch, threshold, nearest=nearest)
    assert np.abs(rows_of(exact(buffers).color) - expected).max() < 1e-12
    single = {name: image.float() for name, image in buffers.items()}
    for fused in (False, True):
        denoiser = RHF(scales, window, patch, threshold, nearest=nearest, fused=fused)
        assert np.abs(rows_of(denoiser(single).color) - expected).max() < 1e-5
    assert np.abs(expected - rows_of(buffers["color"])).max() > 0.1


def test_pixels_with_different_numbers_of_samples_are_compared_as_the_formula_says() -> None:
    samples = noisy(10, 9, 12)
    samples[5:, :, ::2] = torch.nan
    samples[:, :, 4, 4] = torch.nan
    buffers = {"color": samples.nanmean(0).nan_to_num()[None], "histogram": histogram_of(samples[None])}
    found = RHF(1, 2)(buffers).color
    assert np.abs(rows_of(found) - plain(buffers, 1, 2)).max() < 1e-12


@pytest.mark.parametrize("size", [(1, 9), (9, 1), (2, 7), (1, 1)])
def test_images_narrower_than_a_patch_follow_the_formula(size: tuple[int, int]) -> None:
    buffers = buffers_of(noisy(*size))
    for scales in (1, 2):
        found = RHF(scales, 3)(buffers).color
        assert np.abs(rows_of(found) - plain(buffers, scales, 3)).max() < 1e-12


def test_where_all_patches_are_accepted_single_pixels_become_the_mean_of_their_window() -> None:
    buffers = buffers_of(noisy(12, 12))
    found = RHF(1, 2, 0, 1e9)(buffers).color
    inner = torch.nn.functional.avg_pool2d(buffers["color"], 5, 1)
    torch.testing.assert_close(found[..., 2:-2, 2:-2], inner, rtol=1e-12, atol=0)


def test_pixels_of_different_distributions_with_equal_means_are_not_mixed() -> None:
    samples = torch.full((16, 3, 16, 16), 1.0, dtype=torch.float64)
    samples[::2, :, :, 8:], samples[1::2, :, :, 8:] = 0.0, 2.0
    mark = torch.zeros(1, 3, 16, 16, dtype=torch.float64)
    mark[..., 8:] = 1.0
    buffers = {"color": mark, "histogram": histogram_of(samples[None])}
    found = RHF(1, nearest=0)(buffers).color
    # Patches that lie across the edge are only like others that do.
    torch.testing.assert_close(found, mark, rtol=0, atol=1e-12)


def test_a_pixel_unlike_all_others_is_averaged_with_its_nearest_only_where_that_is_asked_for() -> None:
    samples = noisy(9, 9, 32)
    samples[:, :, 4, 4] += 40.0
    buffers = buffers_of(samples)
    alone = RHF(1, 2, 0, nearest=0)(buffers).color[..., 4, 4]
    torch.testing.assert_close(alone, buffers["color"][..., 4, 4], rtol=1e-12, atol=0)
    together = RHF(1, 2, 0, nearest=2)(buffers).color[..., 4, 4]
    assert (together < 0.5 * alone).all()


def test_a_smaller_threshold_keeps_more_noise_and_two_scales_leave_less_of_low_frequency() -> None:
    generator = torch.Generator().manual_seed(2)
    samples = -torch.rand(8, 3, 64, 64, generator=generator).log()
    buffers = buffers_of(samples)
    left = {
        key: float((RHF(*key)(buffers).color - 1).square().mean())
        for key in ((1, 6, 1, 0.4), (1, 6, 1, 0.8), (2, 6, 1, 0.8))
    }
    assert left[2, 6, 1, 0.8] < left[1, 6, 1, 0.8] < 0.5 * left[1, 6, 1, 0.4]


@pytest.mark.parametrize("fused", [False, True])
def test_strips_of_any_height_give_the_same_bits(fused: bool) -> None:
    buffers = {name: image.float() for name, image in buffers_of(noisy(34, 21)).items()}
    whole = RHF(window=3, fused=fused)(buffers).color
    for memory in (1, 300_000):
        assert torch.equal(RHF(window=3, memory=memory, fused=fused)(buffers).color, whole)


def test_a_coarser_histogram_holds_the_samples_of_four_pixels_and_the_shares_of_the_low_pass() -> None:
    histogram = histogram_of(noisy(8, 12, 6)[None])
    small = coarser_histogram(histogram)
    assert small.shape == (1, 60, 4, 6)
    torch.testing.assert_close(small, 4 * coarser(histogram), rtol=1e-12, atol=1e-12)
    sums = small.unflatten(1, (3, 20)).sum(2)
    torch.testing.assert_close(sums, torch.full_like(sums, 24.0), rtol=1e-6, atol=0)


def test_a_firefly_of_one_sample_fills_no_bin_and_is_averaged_away_but_one_of_several_samples_is_not() -> (
    None
):
    samples = noisy(16, 16, 8)
    for fireflies, low, high in ((1, 0.0, 0.2), (4, 0.9, 1.1)):
        samples[:fireflies, :, 8, 8] = 1e6
        buffers = buffers_of(samples)
        found = RHF(1, patch=0, nearest=0)(buffers).color
        assert found.isfinite().all()
        assert low <= float(found.max() / buffers["color"].max()) <= high


def test_broken_histograms_count_as_none() -> None:
    buffers = buffers_of(noisy(16, 16))
    broken = {**buffers, "histogram": buffers["histogram"].clone()}
    broken["histogram"][:, 7, 4, 4], broken["histogram"][:, 3, 9, 2] = torch.nan, torch.inf
    assert RHF()(broken).color.isfinite().all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_radiance_that_is_not_finite_counts_as_0(value: float) -> None:
    buffers = buffers_of(noisy(16, 17))
    broken, black = ({**buffers, "color": buffers["color"].clone()} for _ in range(2))
    broken["color"][..., 5, 6], black["color"][..., 5, 6] = value, 0.0
    assert torch.equal(RHF()(broken).color, RHF()(black).color)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16], ids=str)
def test_half_precision_is_computed_with_in_float32(kind: torch.dtype) -> None:
    rounded = {name: image.to(kind) for name, image in buffers_of(noisy(16, 17)).items()}
    found = RHF()(rounded).color
    assert found.dtype == torch.float32
    assert torch.equal(found, RHF()({name: image.float() for name, image in rounded.items()}).color)


def test_gradients_of_the_image_are_those_of_fixed_weights() -> None:
    buffers = buffers_of(noisy(4, 3))
    kernel = HistogramKernel(1, 1, 0.8, 1)
    with torch.enable_grad():
        image = buffers["color"].clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda x: histogram_filter(x, buffers["histogram"], kernel), image)


def test_a_missing_histogram_names_the_commands_that_make_one() -> None:
    color = buffers_of(noisy(16, 16))["color"]
    with pytest.raises(ValueError, match=r"missing: histogram.*trainer render stills --histogram.*samples"):
        RHF()({"color": color})
    with pytest.raises(ValueError, match=r"missing: color; given: histogram$"):
        RHF()({"histogram": color})


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="scales must be at least 1"):
        RHF(0)
    with pytest.raises(ValueError, match="window radius >= 1"):
        RHF(1, 0)
    with pytest.raises(ValueError, match="threshold > 0"):
        RHF(threshold=0.0)
    with pytest.raises(ValueError, match=r"nearest patches >= 0, got 0\.8 and -1"):
        RHF(nearest=-1)


def test_batches_give_what_single_images_do() -> None:
    one, other = buffers_of(noisy(16, 17)), buffers_of(noisy(16, 17, seed=3))
    both = {name: torch.cat([one[name], other[name]]) for name in one}
    found = RHF()(both).color
    for row, single in enumerate((one, other)):
        assert largest_relative(found[row : row + 1], RHF()(single).color) < 1e-12
