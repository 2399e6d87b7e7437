"""Samples of foreign origin: brought into their ranges, and the images that their means are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import SAMPLE_BUFFERS
from data.dropped import mark, mean
from data.frame import Image, Samples

_TOLERANCE = 1e-3
"""Values this far outside their range are rounding and are not counted."""


def clean(parts: dict[str, NDArray[np.float32]], notes: dict[str, Any]) -> Samples:
    """Return samples within their ranges, in the order of the vocabulary.

    Samples with a value that is not finite are marked and counted (`data.dropped`) in `notes["dropped"]`,
    infinite distances replaced and counted in `notes["repaired"]["samples"]`; other values are clipped,
    counted per quantity in `notes["clipped"]`.

    Args:
        parts: Quantity → float32 (S, H, W, c).
        notes: Receives the counts.
    """
    samples = Samples.of({name: parts[name] for name in SAMPLE_BUFFERS if name in parts})
    dropped, replaced = mark(samples.values, samples.channels)
    if dropped is not None:
        notes["dropped"] = list(dropped)
    if replaced:
        notes.setdefault("repaired", {})["samples"] = replaced
    for name in samples.names:
        entry, values = SAMPLE_BUFFERS[name], samples.get(name)
        outside = 0
        if entry.low is not None:
            outside += int((values < entry.low - _TOLERANCE).sum())
            np.maximum(values, np.float32(entry.low), out=values)
        if entry.high is not None:
            outside += int((values > entry.high + _TOLERANCE).sum())
            np.minimum(values, np.float32(entry.high), out=values)
        if outside:
            notes.setdefault("clipped", {})[f"samples.{name}"] = outside
    return samples


def means(samples: Samples, names: Iterable[str]) -> dict[str, Image]:
    """Return the mean of each named quantity that the samples have, (H, W, c), NaN where none counts."""
    return {name: mean(samples.get(name)) for name in names if name in samples.names}
