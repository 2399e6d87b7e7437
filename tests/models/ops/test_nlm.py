"""Weights of non-local means are their formula, on the CPU in PyTorch and in the fused kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops import nlm
from models.ops.nlm import Guide, PatchKernel, nlm_filter, strips
from tests.models import plain_nlm
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread")


def random_guide(
    height: int = 19, width: int = 23, channels: int = 3, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return an image to filter, a guide with an edge and a variance that differs per pixel."""
    generator = torch.Generator().manual_seed(seed)
    image, noise, spread = torch.rand(3, 1, channels, height, width, generator=generator)
    edge = (torch.arange(width) > width // 2).float()
    return image, edge + 0.3 * noise, 0.02 * spread.square()


def rows_columns(image: Tensor) -> Any:
    return image[0].permute(1, 2, 0).double().numpy()


def filtered(image: Tensor, guide: Tensor, variance: Tensor, kernel: PatchKernel, **how: Any) -> Tensor:
    return nlm_filter(image[:, None], [Guide(guide, variance)], kernel, **how)[:, 0]


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize(("window", "patch"), [(5, 3), (6, 1), (3, 2), (2, 0)])
def test_filtering_equals_the_transcription(window: int, patch: int, fused: bool) -> None:
    image, guide, variance = random_guide()
    kernel = PatchKernel(window, patch, (0.5,), scale=2.0)
    found = filtered(image, guide, variance, kernel, fused=fused)
    expected = plain_nlm.nlm(
        rows_columns(image), rows_columns(guide), rows_columns(variance), patch, window, 0.5, 2
    )
    assert np.abs(rows_columns(found) - expected).max() < 2e-6


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("channels", ["least", "mean"])
def test_one_weight_for_all_channels_is_the_smallest_or_that_of_the_mean_distance(
    channels: str, fused: bool
) -> None:
    image, guide, variance = random_guide()
    kernel = PatchKernel(3, 2, (0.8,), channels=channels)
    found = rows_columns(filtered(image, guide, variance, kernel, fused=fused))
    source = (rows_columns(guide), rows_columns(variance))
    total, norm = np.zeros((19, 23, 3)), np.zeros((19, 23, 1))
    for offset in plain_nlm.window(3):
        d, there = plain_nlm.patch_distance(source, source, offset, 2, 0.8, mean_channels=channels == "mean")
        w = plain_nlm.weight(d, there, offset).min(-1, keepdims=True)
        total += w * np.nan_to_num(plain_nlm.shifted(rows_columns(image), *offset))
        norm += w
    assert np.abs(found - total / norm).max() < 2e-6


@pytest.mark.parametrize("fused", [False, True])
def test_pixels_without_a_variance_stay_as_they_are_and_everything_is_finite(fused: bool) -> None:
    image, guide, variance = random_guide()
    variance[..., 9, 11] = torch.nan
    kernel = PatchKernel(5, 3, (0.5,))
    found = filtered(image, guide, variance, kernel, fused=fused)
    assert found.isfinite().all()
    near = (..., slice(6, 13), slice(8, 15))
    torch.testing.assert_close(found[near], image[near], rtol=1e-5, atol=0)
    expected = plain_nlm.nlm(rows_columns(image), rows_columns(guide), rows_columns(variance), 3, 5, 0.5, 1)
    assert np.abs(rows_columns(found) - expected).max() < 2e-6


def test_strips_equal_the_whole() -> None:
    image, guide, variance = random_guide(43, 21)
    kernel = PatchKernel(4, 2)
    expected = filtered(image, guide, variance, kernel, fused=False)
    assert torch.equal(filtered(image, guide, variance, kernel, budget=1.0, fused=False), expected)


def test_strips_cover_every_row_once_and_have_at_least_8_rows() -> None:
    for height in (1, 8, 17, 100):
        for budget in (1.0, 90.0, 1e9):
            cuts = strips(height, 10.0, budget, torch.device("cpu"))
            assert [r for start, stop in cuts for r in range(start, stop)] == list(range(height))
            assert len(cuts) == 1 or min(stop - start for start, stop in cuts) >= 4


def test_without_a_budget_strips_fit_the_cache_on_a_cpu_and_are_large_elsewhere() -> None:
    cpu, other = (strips(1000, 1e6, None, torch.device(name)) for name in ("cpu", "meta"))
    assert max(stop - start for start, stop in cpu) <= 64
    assert other == [(0, 1000)]


@pytest.mark.parametrize("threads", [1, 2])
def test_fused_filtering_equals_pytorch_on_images_of_many_tiles(threads: int) -> None:
    image, guide, variance = random_guide(35, 150)
    for kernel in (PatchKernel(5, 3, (0.5,)), PatchKernel(9, 1), PatchKernel(2, 3, channels="mean")):
        torch.set_num_threads(1)
        expected = filtered(image, guide, variance, kernel, fused=False)
        torch.set_num_threads(threads)
        assert largest_relative(filtered(image, guide, variance, kernel, fused=True), expected) < 2e-6


def test_windows_over_frames_take_neighbours_from_all_frames() -> None:
    image, guide, variance = random_guide(16, 18)
    other, other_guide, other_variance = random_guide(16, 18, seed=3)
    kernel = PatchKernel(2, 1, (2.0,))
    guides = [Guide(other_guide, other_variance), Guide(guide, variance)]
    frames = [other[:, None], image[:, None]]
    found = [
        nlm_filter(frames[1], guides, kernel, neighbours=frames, centre=1, fused=f)[:, 0]
        for f in (False, True)
    ]
    own, source = rows_columns(image), (rows_columns(guide), 1.0 * rows_columns(variance))
    total, norm = np.zeros_like(own), np.zeros_like(own)
    for frame, target in ((guides[0], other), (guides[1], image)):
        for offset in plain_nlm.window(2):
            there = (rows_columns(frame.image), rows_columns(frame.variance))
            d, inside = plain_nlm.patch_distance(source, there, offset, 1, 2.0)
            w = plain_nlm.weight(d, inside, offset if target is image else (9, 9))
            total += w * np.nan_to_num(plain_nlm.shifted(rows_columns(target), *offset))
            norm += w
    for result in found:
        assert np.abs(rows_columns(result) - total / norm).max() < 2e-6


def test_without_numba_the_fused_form_is_refused_and_pytorch_takes_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nlm, "_has_numba", lambda: False)
    image, guide, variance = random_guide()
    with pytest.raises(ValueError, match=r"Numba, which is not installed: pip install .*\[fast\]"):
        filtered(image, guide, variance, PatchKernel(2, 1), fused=True)
    found = filtered(image, guide, variance, PatchKernel(2, 1))
    assert torch.equal(found, filtered(image, guide, variance, PatchKernel(2, 1), fused=False))


def test_double_precision_and_gradients_run_in_pytorch() -> None:
    image = random_guide()[0]
    assert nlm.use_fused(None, image)
    assert not nlm.use_fused(None, image.double())
    assert not nlm.use_fused(True, image.clone().requires_grad_())
    assert not nlm.use_fused(False, image)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1), "window radius >= 1"),
        ((2, -1), "patch radius >= 0"),
        ((2, 1, (0.0,)), "bandwidths > 0"),
        ((2, 1, (1.0,), 1.0, "most"), "own, least or mean"),
    ],
)
def test_impossible_kernels_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PatchKernel(*arguments)
