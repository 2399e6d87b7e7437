"""Non-local means, joint and multi-scale, and the bilateral filter, are their formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from models import NLM, CrossBilateral, JointNLM, MultiScaleNLM
from models.ops.joint import squared_gradient
from models.ops.pyramid import coarser, coarser_variance, finer
from tests.models import plain_nlm
from tests.models.frames import largest_relative, split_buffers

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")


def as_rows(image: Tensor) -> plain_nlm.Array:
    return np.asarray(image[0].permute(1, 2, 0).double().numpy())


def test_each_half_is_filtered_with_weights_of_the_other() -> None:
    buffers = split_buffers(1, 17, 19)
    a, b, variance = (as_rows(buffers[f"color_{part}"]) for part in ("a", "b", "variance"))
    expected = np.zeros_like(a)
    for image, guide in ((a, b), (b, a)):
        source = (guide, 2 * variance)
        total, norm = np.zeros_like(a), np.zeros((17, 19, 1))
        for offset in plain_nlm.window(4):
            d, there = plain_nlm.patch_distance(source, source, offset, 2, 0.45, 1e-10, mean_channels=True)
            w = plain_nlm.weight(d, there, offset)
            total += w * np.nan_to_num(plain_nlm.shifted(image, *offset))
            norm += w
        expected += 0.5 * total / norm
    for fused in (False, True):
        found = NLM(4, 2, fused=fused)(buffers).color
        assert np.abs(as_rows(found) - expected).max() < 1e-5


def test_an_edge_that_only_a_feature_shows_is_kept_by_the_joint_filter() -> None:
    buffers = split_buffers(1, 24, 24)
    for part in ("a", "b", "variance"):
        flat = {"a": 1.0, "b": 1.0, "variance": 0.5}[part]
        buffers[f"color_{part}"] = torch.full((1, 3, 24, 24), flat)
        buffers[f"albedo_{part}"] = torch.zeros(1, 3, 24, 24)
    for part in ("a", "b"):
        buffers[f"color_{part}"][..., 12:] = 1.5
        buffers[f"albedo_{part}"][..., 12:] = 1.0
    mixed = NLM()(buffers).color
    for combine in ("least", "product"):
        kept = JointNLM(("albedo",), combine)(buffers).color
        expected = 0.5 * (buffers["color_a"] + buffers["color_b"])
        assert largest_relative(kept, expected) < 1e-4
    assert (mixed[..., 11] > 1.1).all()


def test_without_features_the_joint_filter_is_the_plain_one() -> None:
    buffers = split_buffers(1, 16, 18)
    expected = NLM(3, 1, fused=False)(buffers).color
    assert largest_relative(JointNLM((), window=3, patch=1)(buffers).color, expected) < 1e-6


def test_the_gradient_of_an_edge_counts_on_neither_side_and_that_of_a_ramp_everywhere_inside() -> None:
    edge = (torch.arange(8.0) > 3).float().expand(1, 1, 8, 8)
    assert (squared_gradient(edge) == 0).all()
    ramp = (0.5 * torch.arange(8.0)).expand(1, 1, 8, 8)
    found = squared_gradient(ramp)
    assert torch.equal(found[..., 1:-1], torch.full((1, 1, 8, 6), 0.25**2))
    assert (found[..., [0, -1]] == 0).all()


def test_one_scale_is_plain_and_constants_stay_at_any_number_of_scales() -> None:
    buffers = split_buffers(1, 21, 19)
    assert torch.equal(MultiScaleNLM(1, 3, 1)(buffers).color, NLM(3, 1)(buffers).color)
    for part in "ab":
        buffers[f"color_{part}"] = torch.full((1, 3, 21, 19), 0.7)
    found = MultiScaleNLM(3, 3, 1)(buffers).color
    torch.testing.assert_close(found, torch.full_like(found, 0.7), rtol=1e-5, atol=0)


def test_more_scales_leave_less_noise_of_low_frequency() -> None:
    generator = torch.Generator().manual_seed(1)
    a, b = (1 + 0.5 * torch.randn(1, 3, 64, 64, generator=generator) for _ in "ab")
    buffers = {"color_a": a, "color_b": b, "color_variance": torch.full_like(a, 0.125)}
    left = [float((m(buffers).color - 1).square().mean()) for m in (NLM(3), MultiScaleNLM(2, 3))]
    assert left[1] < 0.6 * left[0]


def test_the_pyramid_keeps_means_and_propagates_variance() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1, 1, 256, 256, generator=generator)
    small = coarser(noise)
    assert small.shape == (1, 1, 128, 128)
    expected = coarser_variance(torch.ones_like(noise))
    inner = (..., slice(4, -4), slice(4, -4))
    assert abs(float(small[inner].var() / expected[inner].mean()) - 1) < 0.05
    ramp = torch.arange(32.0).expand(1, 1, 32, 32)
    # PyTorch's bicubic, with a = -0.75, bends ramps by up to a tenth of their step.
    torch.testing.assert_close(finer(coarser(ramp))[..., 8:-8], ramp[..., 8:-8], rtol=0, atol=0.1)


def test_the_bilateral_filter_is_equation_2() -> None:
    color = split_buffers(1, 16, 17)["color"]
    found = CrossBilateral(2, 1.5, 0.3, smoothing=0)({"color": color}).color[0].double()
    guide = torch.log1p(color[0].double())
    for y, x in [(0, 0), (15, 16), (7, 8)]:
        total, norm = torch.zeros(3, dtype=torch.float64), 0.0
        for v in range(max(0, y - 2), min(16, y + 3)):
            for u in range(max(0, x - 2), min(17, x + 3)):
                exponent = ((v - y) ** 2 + (u - x) ** 2) / 1.5**2
                exponent += float((guide[:, v, u] - guide[:, y, x]).square().sum()) / 0.3**2
                share = math.exp(-0.5 * exponent)
                total, norm = total + share * color[0, :, v, u].double(), norm + share
        assert largest_relative(found[:, y, x], total / norm) < 1e-5


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="scales must be at least 1"):
        MultiScaleNLM(0)
    with pytest.raises(ValueError, match="combine must be least or product"):
        JointNLM(combine="sum")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="bandwidth tonal must be positive"):
        CrossBilateral(tonal=0.0)
