"""Weighted local regression by compiled kernels: `models.ops.local_regression`, some rows at a time.

A band of rows is estimated as far ahead as the Gaussian that smooths bandwidths looks, smoothed and finished;
what was found in the rows ahead is kept for the next band. Everything is in float64, as there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from models.ops import fused
from models.ops.feature_windows import Stack
from models.ops.shared_bandwidth import shared_bandwidth, smoothed

if TYPE_CHECKING:
    from models.ops.local_regression import LocalRule


def banded_regression(stack: Stack, rule: LocalRule, budget: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return colour (B, 3, H, W), smoothed bandwidth and rank (B, 1, H, W) in float64."""
    images = [_fitted(local, rule, budget) for local in _images(stack, rule)]
    color, bandwidth, rank = (torch.stack(parts) for parts in zip(*images, strict=True))
    return color, bandwidth, rank


def _images(stack: Stack, rule: LocalRule) -> list[fused.Local]:
    """Return what the kernels read of every image."""
    first = stack.dimensions - 2
    color, variance, known = stack.padded[:, first:].split([3, 1, 1], 1)
    parts = (stack.padded, variance.sqrt(), color.mean(1, keepdim=True), known / variance.clamp_min(1.0))
    images = torch.cat(parts, 1).numpy()
    noise = stack.noise.contiguous().numpy()
    groups = np.array(stack.groups[2:], np.int64)
    trials = np.array(sorted(rule.trials))
    numbers = fused.Numbers(*(getattr(rule, name) for name in fused.Numbers._fields))
    return [
        fused.Local(image, own, groups, numbers, trials) for image, own in zip(images, noise, strict=True)
    ]


def _fitted(local: fused.Local, rule: LocalRule, budget: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return colour (3, H, W), bandwidth and rank (1, H, W) of one image."""
    height, width = local.noise.shape[:2]
    size, threads = 2 + int(local.groups.sum()), torch.get_num_threads()
    row_bytes = 8 * width * (size * (size + 4) + 4 * len(rule.trials) + 10)
    step = max(1, int(budget / row_bytes) - rule.map_reach)
    color, smooth = np.empty((3, height, width)), torch.empty(height, width, dtype=torch.float64)
    rank, shared = np.empty((height, width)), torch.empty(height, width, dtype=torch.float64)
    kept: fused.Found | None = None
    done = 0
    for top in range(0, height, step):
        stop = min(height, top + step)
        ahead = min(height, stop + rule.map_reach)
        if done < ahead:
            found = fused.estimate(local, (done, ahead), threads)
            shared[done:ahead] = _shared(found, local, rule)
            rank[done:ahead] = found.rank
            kept = found.after(kept)
        done = ahead
        assert kept is not None
        low = max(0, top - rule.map_reach)
        around = smoothed(shared[None, None, low:ahead], rule.map_sigma, rule.map_reach)[0, 0]
        smooth[top:stop] = around[top - low : stop - low]
        color[:, top:stop] = fused.finish(local, (top, stop), kept, smooth[top:stop].numpy(), threads)
        kept = kept.from_row(stop - top)
    return torch.from_numpy(color), smooth[None], torch.from_numpy(rank)[None]


def _shared(found: fused.Found, local: fused.Local, rule: LocalRule) -> Tensor:
    """Return the bandwidths (rows, W) of least estimated error."""
    bias, variance, rank = (
        torch.from_numpy(x) for x in (found.bias, found.variance, found.rank.astype(float))
    )
    parts = (bias.flatten(1), variance.flatten(1), rank.flatten())
    return shared_bandwidth(local.trials.tolist(), *parts, rule.least_bandwidth).reshape(rank.shape)
