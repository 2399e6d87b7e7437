"""Samples that are kept apart: which channels a network reads, and which samples count.

A sample counts when all of its channels are finite, except that distances may be infinite; others are
dropped, pixel by pixel. So a pixel may have fewer samples than the frame, or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from data.buffers import MAY_BE_INFINITE, SAMPLE_BUFFERS, sample_channels
from models.ops.boxes import exporting
from models.ops.guides import depth_range, finite
from models.ops.loops import looped
from models.ops.streaming import strip_rows


def arranged(
    samples: Tensor, channels: Sequence[str], names: Sequence[str], fill: Mapping[str, float] | None = None
) -> Tensor:
    """Return the channels that a network reads, in its order.

    Args:
        samples: (B, S, C, H, W).
        channels: What the C channels are, such as `radiance.R`.
        names: Per-sample quantities that are wanted, in order (`data.buffers.SAMPLE_BUFFERS`).
        fill: Quantity → the constant that stands for it where the samples lack it.

    Returns:
        (B, S, C', H, W); the same tensor where nothing changes.

    Raises:
        ValueError: A quantity is missing and has no constant; names it, and what the samples have.
    """
    channels = tuple(channels)
    if samples.ndim != 5 or samples.shape[2] != len(channels):
        raise ValueError(
            f"samples have shape {tuple(samples.shape)}, expected (B, S, {len(channels)}, H, W) for the "
            f"channels {', '.join(channels)}"
        )
    wanted, fill = sample_channels(*names), fill or {}
    if wanted == channels:
        return samples
    lacking = [n for n in names if n not in fill and not set(sample_channels(n)) <= set(channels)]
    if lacking:
        held = dict.fromkeys(channel.partition(".")[0] for channel in channels)
        constants = ", ".join(f"{name}: {SAMPLE_BUFFERS[name].no_hit:g}" for name in lacking)
        raise ValueError(
            f"the samples have no {', '.join(lacking)}; they have {', '.join(held)}. Render or ingest frames "
            f"with them, or say what stands for them: fill: {{{constants}}}"
        )
    result = samples.new_empty(*samples.shape[:2], len(wanted), *samples.shape[3:])
    for place, channel in enumerate(wanted):
        if channel in channels:
            result[:, :, place] = samples[:, :, channels.index(channel)]
        else:
            result[:, :, place] = fill[channel.partition(".")[0]]
    return result


def check_samples(samples: Tensor, channels: Sequence[str], reader: str) -> tuple[int, int]:
    """Check the shape of samples and return (S, C).

    Raises:
        ValueError: It is not (B, S, C, H, W) with at least one sample and these channels.
    """
    shape = tuple(samples.shape)
    if len(shape) != 5 or shape[1] == 0 or shape[2] != len(channels):
        raise ValueError(
            f"{reader}: buffer 'samples' has shape {shape}, expected (B, S, {len(channels)}, H, W) with at "
            f"least one sample and the channels {', '.join(channels)}"
        )
    return shape[1], shape[2]


FEATURE_LIMIT = 1000.0
"""What networks see is clipped to +- this."""


class Seen(NamedTuple):
    """Samples as networks see them; those that do not count are 0.

    Attributes:
        radiance: Exposed linear radiance (B, S, 3, H, W).
        features: What a network reads, (B, S, C, H, W).
        counts: 1 where a sample counts, otherwise 0, (B, S, 1, H, W).
    """

    radiance: Tensor
    features: Tensor
    counts: Tensor


def seen(radiance: Tensor, features: Sequence[Tensor], counts: Tensor) -> Seen:
    """Return samples with clipped features, and 0 where a sample does not count.

    Args:
        radiance: Exposed linear radiance (B, S, 3, H, W).
        features: (B, S, C, H, W) each, in the order in which a network reads them.
        counts: Which samples count, bool (B, S, 1, H, W).
    """
    clipped = torch.cat(list(features), 2).clamp(-FEATURE_LIMIT, FEATURE_LIMIT)
    weight = counts.to(radiance.dtype)
    return Seen(radiance * weight, clipped * weight, weight)


def known(samples: Tensor, names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return samples with 0 for all that is not finite, and which of them count, bool (B, S, 1, H, W).

    Infinite distances are 0 as well, and the sample counts: the ray left the scene.

    Args:
        samples: (B, S, C, H, W), raw.
        names: What the C channels are: quantities in order.
    """
    # A sum tells in a fraction of the time that nothing is to be done. Other devices would be waited for.
    if not exporting() and samples.device.type == "cpu" and bool(samples.sum().isfinite()):
        return samples, torch.ones_like(samples[:, :, :1], dtype=torch.bool)
    far = [channel.partition(".")[0] in MAY_BE_INFINITE for channel in sample_channels(*names)]
    if any(far):
        # Not torch.tensor: recorded graphs would hold the device on which they were recorded.
        mask = torch.stack([samples.new_full((1, 1), float(one)) for one in far]) > 0
        samples = samples.where(~(mask & samples.isinf()), 0.0)
    counts = whole(samples)
    return samples.where(counts, 0.0), counts


def sample_depths(samples: Tensor, names: Sequence[str]) -> Tensor:
    """Return the smallest and the largest depth (B, 2) of the samples of whole frames that count.

    Args:
        samples: (B, S, C, H, W), raw.
        names: What the C channels are; `depth` is among them.
    """
    place = sample_channels(*names).index("depth.Z")
    if not torch.jit.is_tracing():
        parts = [samples]
        if not exporting():  # strips of single samples
            rows = strip_rows(samples, samples.shape[0] * samples.shape[2])
            parts = [strip for one in samples.split(1, 1) for strip in one.split(rows, -2)]
        each = torch.stack([depth_range(known(part, names)[0][:, :, place]) for part in parts])
        return torch.stack([each[..., 0].amin(0), each[..., 1].amax(0)], 1)

    def bounds(samples: Tensor) -> Tensor:
        depths = finite(known(samples, names)[0][:, :, place]).clamp_min(0.0)
        return torch.stack([depths.amin(1), depths.amax(1)], 1)

    made = looped(bounds, [samples], [], samples.shape[0] * samples.shape[1] * samples.shape[2])
    return torch.stack([made[:, 0].amin((1, 2)), made[:, 1].amax((1, 2))], 1)


def whole(samples: Tensor) -> Tensor:
    """Return which samples count, bool (B, S, 1, H, W): those whose channels are all finite.

    Args:
        samples: (B, S, C, H, W).
    """
    # x - x is 0 for finite x, otherwise not a number; recorded graphs have few operators to ask with.
    return (samples - samples).sum(2, keepdim=True) == 0


def sample_counts(samples: Tensor) -> Tensor:
    """Return how many samples of each pixel count, float (B, 1, H, W), one sample at a time."""
    counts = samples.new_zeros(samples.shape[0], 1, *samples.shape[3:])
    for number in range(samples.shape[1]):
        counts += whole(samples[:, number : number + 1])[:, 0]
    return counts
