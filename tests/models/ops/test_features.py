"""Filtered features are those of the float64 transcription."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.ops.features import Prefilter, filter_frames
from models.ops.halves import Halves
from models.ops.nlm import PatchKernel
from tests.models.plain_nlm import nlm

FILTER = Prefilter(window=3, patch=1, again=1, fused=False)


def feature(frames: int = 1, size: int = 13, seed: int = 0) -> Halves:
    generator = torch.Generator().manual_seed(seed)
    shape = (1, frames, 2, size, size)
    steps = torch.arange(size).mul(0.4).sin() * torch.linspace(0, 1, size)[:, None]
    variance = 0.01 * torch.rand(shape, generator=generator).double()
    a, b = (steps + (2 * variance).sqrt() * torch.randn(shape, generator=generator) for _ in "ab")
    return Halves(a, b, variance)


def image(tensor: Tensor) -> Any:
    return tensor[0, 0].permute(1, 2, 0).numpy()


def close(found: Tensor, expected: Any) -> bool:
    return bool(np.abs(image(found) - expected).max() < 1e-9)


def test_halves_are_filtered_by_each_other_and_their_mean_once_more() -> None:
    halves = feature()
    a, b, v = (image(x) for x in halves)
    once_a, once_b = nlm(a, b, v, 1, 3, 0.5, 2), nlm(b, a, v, 1, 3, 0.5, 2)
    mean, left = (once_a + once_b) / 2, (once_b - once_a) ** 2 / 4
    found = FILTER(halves, "measured")
    assert close(found.a, once_a)
    assert close(found.b, once_b)
    assert close(found.final, nlm(mean, mean, left, 1, 1, 0.5, 1))
    twice_a, twice_b = nlm(once_a, once_b, left, 1, 1, 0.5, 2), nlm(once_b, once_a, left, 1, 1, 0.5, 2)
    found = Prefilter(3, 1, 1, "halves", fused=False)(halves, "measured")
    assert close(found.a, twice_a)
    assert close(found.final, (twice_a + twice_b) / 2)


def test_one_buffer_is_filtered_once_with_its_own_variance() -> None:
    a, _, v = feature()
    found = FILTER(Halves(a, a, 0.5 * v), "variance")
    assert found.a is found.b
    assert close(found.final, nlm(image(a), image(a), image(v), 1, 3, 0.5, 1))


def test_what_has_no_noise_is_not_touched() -> None:
    a, b, _ = feature()
    found = FILTER(Halves(a, b, torch.zeros_like(a)), "none")
    assert found.a is a
    assert found.final is a


def test_pixels_near_a_variance_that_is_not_a_number_stay_as_they_are_and_others_do_not_see_it() -> None:
    halves = feature(size=15)
    halves.variance[..., 7, 7] = torch.nan
    found = FILTER(halves, "measured")
    near = (..., slice(6, 9), slice(6, 9))
    assert torch.allclose(found.a[near], halves.a[near], atol=1e-12)
    assert found.final.isfinite().all()
    assert not torch.allclose(found.a[..., 2:5, 2:5], halves.a[..., 2:5, 2:5], atol=1e-3)


def test_the_reach_is_what_is_read() -> None:
    for second in ("mean", "halves"):
        chosen = Prefilter(2, 1, 1, second, fused=False)  # type: ignore[arg-type]
        assert chosen.reach_final == 2 + 1 + 1 + 1
        assert chosen.reach == (3 if second == "mean" else 5)


def test_frames_are_filtered_one_by_one() -> None:
    three = feature(frames=3)
    kernel = PatchKernel(2, 1)
    maps = torch.stack([three.a, three.b])
    found = filter_frames(maps, three.a, three.variance, kernel, 1e6, fused=False)
    for t in range(3):
        part = (slice(None), slice(t, t + 1))
        alone = filter_frames(
            maps[:, :, t : t + 1], three.a[part], three.variance[part], kernel, 1e6, fused=False
        )
        assert torch.equal(found[:, :, t : t + 1], alone)
