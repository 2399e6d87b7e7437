"""Samples that do not count: those with a value that is not finite, marked as a whole by NaN.

A renderer that divides by a probability of 0 writes NaN. Neither black nor any other number may stand for
such a sample: the pixel is estimated by the mean over its other samples, so every channel of it becomes NaN,
in frames, files and shards alike. Networks leave these samples out (`models.ops.per_sample`), and so do the
means made here; a pixel without any sample that counts is filled from around it.

Infinite distances are no errors: renderers write them where a ray left the scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import MAY_BE_INFINITE, SAMPLE_BUFFERS
from data.repair import all_finite

Values = NDArray[np.float32]


class Dropped(NamedTuple):
    """What does not count in a frame.

    Attributes:
        samples: Samples that are dropped.
        pixels: Pixels that they lie in.
        empty: Pixels without any other.
    """

    samples: int
    pixels: int
    empty: int

    def text(self) -> str:
        """Return one sentence for the user."""
        lost = f"{_number(self.samples, 'sample')} with NaN or Inf in {_number(self.pixels, 'pixel')} "
        lost += "was dropped" if self.samples == 1 else "were dropped"
        if not self.empty:
            return lost
        filled = "was filled from around it" if self.empty == 1 else "were filled from around them"
        return f"{lost}; {_number(self.empty, 'pixel')} had no other and {filled}"


def mark(values: Values, channels: Sequence[str]) -> tuple[Dropped | None, int]:
    """Bring what is not finite to one form, in place: NaN in every channel of a sample that is dropped.

    Infinite values of the quantities in `MAY_BE_INFINITE` become the value of a ray that left the scene.

    Args:
        values: (S, H, W, C).
        channels: What the C channels are.

    Returns:
        What is dropped, None where every sample counts, and how many infinite values were replaced.
    """
    if all_finite(values):
        return None, 0
    replaced = 0
    for place, channel in enumerate(channels):
        name = channel.partition(".")[0]
        if name in MAY_BE_INFINITE:
            plane = values[..., place]
            far = np.isinf(plane)
            replaced += int(far.sum())
            plane[far] = SAMPLE_BUFFERS[name].no_hit
    bad = ~np.isfinite(values).all(-1)
    values[bad] = np.nan
    return count(values), replaced


def count(values: Values) -> Dropped | None:
    """Return what is dropped of samples (S, H, W, C) that are marked, None where every sample counts."""
    bad = np.isnan(values[..., 0])
    if not bad.any():
        return None
    return Dropped(int(bad.sum()), int(bad.any(0).sum()), int(bad.all(0).sum()))


def require_marked(values: Values, channels: Sequence[str]) -> None:
    """Raise a ValueError unless samples (S, H, W, C) are finite, or NaN in every channel."""
    if all_finite(values):
        return
    gone = np.isnan(values[..., 0])
    for place, channel in enumerate(channels):
        plane = values[..., place]
        if np.isinf(plane).any() or not np.array_equal(np.isnan(plane), gone):
            raise ValueError(
                f"samples: channel {channel} holds NaN or Inf where other channels of the sample do "
                "not; mark such samples before writing: data.dropped.mark"
            )


def mean(values: Values) -> Values:
    """Return the mean (H, W, c) over the samples (S, H, W, c) that count, NaN where none does."""
    if all_finite(values):
        return values.mean(0, dtype=np.float32)
    good = ~np.isnan(values)
    number = good.sum(0)
    total = values.sum(0, dtype=np.float32, where=good)
    return np.where(number > 0, total / np.maximum(number, 1), np.float32(np.nan)).astype(np.float32)


def mean_variance(values: Values) -> Values:
    """Return the variance of the mean (H, W, c) of independent samples (S, H, W, c), unbiased.

    It is 0 where one sample counts, and NaN where none does.
    """
    good = ~np.isnan(values)
    number = good.sum(0)
    if values.shape[0] < 2:
        return np.where(number > 0, np.float32(0), np.float32(np.nan))
    centred = np.where(good, values - mean(values).astype(np.float64), 0)
    result = (centred**2).sum(0) / np.maximum(number - 1, 1) / np.maximum(number, 1)
    return np.where(number > 0, result, np.nan).astype(np.float32)


def mean_of_hits(values: Values) -> Values:
    """Return the mean over the samples that are above 0, and 0 where none is: depths, (H, W, c)."""
    hit = values > 0
    total = values.sum(0, where=hit)
    return np.asarray(total / np.maximum(hit.sum(0), 1), np.float32)


def total(found: Iterable[Sequence[int]]) -> Dropped | None:
    """Return the sum over frames, None where there is nothing to add."""
    rows = [tuple(numbers) for numbers in found]
    return Dropped(*(sum(column) for column in zip(*rows, strict=True))) if rows else None


def _number(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
