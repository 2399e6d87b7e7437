"""Which buffers samples hold, and the shape that each has in a batch of several."""

from __future__ import annotations

from collections.abc import Sequence

from data.buffers import SAMPLES, buffer
from data.shards.description import Sample


def available(sample: Sample) -> tuple[str, ...]:
    """Return the buffers that a sample holds or that follow from them."""
    names = dict.fromkeys(sample.buffers)
    if "irradiance" in names and "albedo" in names:
        names["color"] = None
    if "color" in names and "albedo" in names:
        names["irradiance"] = None
    return tuple(names)


def shape_of(samples: Sequence[Sample], name: str, kept: int) -> tuple[int, ...]:
    """Return the shape of a buffer of one of the samples of a batch: (C, H, W), of clips (N, C, H, W).

    Args:
        samples: Of the batch.
        name: The buffer.
        kept: Samples per pixel of `samples`, (S, C, H, W).

    Raises:
        ValueError: The samples do not have the same size, or not the same number of frames.
    """
    size, frames = _size(samples), frames_of(samples)
    if name == SAMPLES:
        return (kept, len(samples[0].sample_channels), *size)
    return (*((frames,) if frames > 1 else ()), buffer(name).channels, *size)


def frames_of(samples: Sequence[Sample]) -> int:
    """Return the number of frames that each sample of a batch has.

    Raises:
        ValueError: Not all have the same.
    """
    numbers = sorted({sample.frames for sample in samples})
    if len(numbers) > 1:
        listed = ", ".join(map(str, numbers))
        raise ValueError(f"clips of different length in one batch: {listed} frames; prepare the set again")
    return numbers[0]


def kept_text(sample: Sample) -> str:
    """Return how many samples of each pixel a sample holds, for messages."""
    stored = sample.buffers.get(SAMPLES)
    return "none" if stored is None else f"{stored.shape[0]} of {len(sample.sample_channels)} channels each"


def _size(samples: Sequence[Sample]) -> tuple[int, int]:
    sizes = {(sample.height, sample.width) for sample in samples}
    if len(sizes) > 1:
        listed = ", ".join(f"{width}x{height}" for height, width in sorted(sizes))
        raise ValueError(f"samples of different size in one batch: {listed}; whole frames need a batch of 1")
    return sizes.pop()
