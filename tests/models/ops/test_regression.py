"""Collaborative regression is the weighted least squares of every window."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops.nlm import Guide, PatchKernel
from models.ops.regression import Sample, collaborative_regression
from tests.models import plain_nfor
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread")

KERNEL = PatchKernel(3, 1, (0.7,), scale=2.0, channels="least")


def sample(height: int = 16, width: int = 18, features: int = 3, seed: int = 0) -> Sample:
    generator = torch.Generator().manual_seed(seed)

    def noise(channels: int) -> Tensor:
        return torch.rand(1, channels, height, width, generator=generator)

    return Sample(noise(3), noise(features), Guide(noise(3), 0.05 * noise(3)))


def fitted(frames: list[Sample], kernel: PatchKernel = KERNEL, fused: bool = False, reach: int = 0) -> Tensor:
    return collaborative_regression(frames, kernel, reach, fused=fused)[0][0]


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("features", [0, 1, 3])
def test_fits_and_predictions_equal_pivoted_qr_window_by_window(features: int, fused: bool) -> None:
    one = sample(features=features)
    image, f, guide, variance = (
        t[0].permute(1, 2, 0).double().numpy() for t in (one.image, one.features, *one.guide)
    )
    weights = plain_nfor.regression_weights(guide, variance, plain_nfor.Radii(window=3, patch=1), 0.7, 2)
    expected = plain_nfor.collaborative_regression(image, f, weights, 3)
    found = fitted([one], fused=fused)[0].permute(1, 2, 0).numpy()
    assert np.abs(found - expected).max() < 1e-4


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("value", [0.3, 1000.0])
def test_a_constant_image_stays_constant(value: float, fused: bool) -> None:
    one = sample()
    flat = Sample(torch.full_like(one.image, value), one.features, one.guide)
    found = fitted([flat], fused=fused)
    torch.testing.assert_close(found, flat.image, rtol=2e-5, atol=0)


@pytest.mark.parametrize("fused", [False, True])
def test_what_is_linear_in_position_and_features_is_reproduced(fused: bool) -> None:
    one = sample(features=2)
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(18.0), indexing="ij")
    image = torch.stack([0.1 * x, 2 - 0.2 * y, one.features[0, 0] - 3 * one.features[0, 1]])[None]
    found = fitted([Sample(image, one.features, one.guide)], fused=fused)
    assert largest_relative(found, image) < 1e-4


@pytest.mark.parametrize("fused", [False, True])
def test_features_that_hardly_differ_are_told_apart_in_windows_of_361_similar_pixels(fused: bool) -> None:
    one = sample(24, 32, features=2)
    nearly = one.features[:, :1] + 3e-3 * one.features[:, 1:]
    features = torch.cat([one.features[:, :1], nearly], 1)
    guide = Guide(one.guide[0], torch.full_like(one.guide[1], 0.3))
    kernel = PatchKernel(9, 3, scale=2.0, channels="least")
    found = fitted([Sample(one.image, features, guide)], kernel, fused)
    exact = Sample(one.image.double(), features.double(), Guide(guide[0].double(), guide[1].double()))
    # Sums of float32 numbers, added one by one, would be wrong by more than 2e-4.
    assert (found - fitted([exact], kernel)).abs().max() < 1e-4


@pytest.mark.parametrize("fused", [False, True])
def test_constant_repeated_and_rescaled_features_change_nothing(fused: bool) -> None:
    one = sample(features=2)
    expected = fitted([one], fused=fused)
    first, second = one.features[:, :1], one.features[:, 1:]
    constant = torch.full_like(first, 0.577) * (1 + 1e-7 * torch.randn_like(first))
    more = torch.cat([first * 1e4, constant, second, first, torch.zeros_like(first)], 1)
    found = fitted([Sample(one.image, more, one.guide)], fused=fused)
    assert largest_relative(found, expected) < 1e-3


def test_strips_equal_the_whole() -> None:
    one = sample(43, 16)
    expected = fitted([one])
    found = collaborative_regression([one], KERNEL, budget=1.0, fused=False)[0][0]
    assert largest_relative(found, expected) < 1e-5


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_fused_fits_equal_pytorch_on_images_of_many_tiles(threads: int) -> None:
    one = sample(35, 150, features=7)
    kernel = PatchKernel(4, 3, (0.5, 1.0), scale=2.0, channels="least")
    expected = collaborative_regression([one], kernel, fused=False)
    torch.set_num_threads(threads)
    found = collaborative_regression([one], kernel, fused=True)
    for a, b in zip(found, expected, strict=True):
        assert largest_relative(a[0], b[0]) < 1e-4


@pytest.mark.parametrize("fused", [False, True])
def test_over_frames_what_is_linear_in_time_is_reproduced(fused: bool) -> None:
    frames = [sample(seed=s) for s in range(3)]
    moving = [
        Sample(f.features + 0.25 * t, f.features, Guide(frames[0].guide.image, f.guide.variance))
        for t, f in enumerate(frames)
    ]
    for t, found in enumerate(collaborative_regression(moving, KERNEL, 1, fused=fused)[0]):
        assert largest_relative(found, moving[t].image) < 1e-4


def test_over_frames_the_fused_form_equals_pytorch() -> None:
    frames = [sample(17, 70, features=2, seed=s) for s in range(4)]
    expected = collaborative_regression(frames, KERNEL, 1, fused=False)[0]
    found = collaborative_regression(frames, KERNEL, 1, fused=True)[0]
    for a, b in zip(found, expected, strict=True):
        assert largest_relative(a, b) < 1e-4
    alone = collaborative_regression(frames[:1], KERNEL, 0, fused=True)[0][0]
    assert largest_relative(found[0], alone) > 1e-3
