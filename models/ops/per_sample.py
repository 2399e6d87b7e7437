"""Samples that are kept apart: which channels a network reads, and which samples count.

A sample counts when all of its channels are finite; others are dropped, pixel by pixel. So a pixel may have
fewer samples than the frame, or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from data.buffers import SAMPLE_BUFFERS, sample_channels


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
