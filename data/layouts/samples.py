"""Samples of foreign origin: brought into their ranges, and the images that their means and variances are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import SAMPLE_BUFFERS
from data.frame import Image, Samples

_TOLERANCE = 1e-3
"""Values this far outside their range are rounding and are not counted."""


def clean(parts: dict[str, NDArray[np.float32]], notes: dict[str, Any]) -> Samples:
    """Return samples of finite values within their ranges, in the order of the vocabulary.

    Values that are not finite become the quantity's value for a ray that left the scene, counted in
    `notes["repaired"]["samples"]`; others are clipped, counted per quantity in `notes["clipped"]`.

    Args:
        parts: Quantity → float32 (S, H, W, c), changed in place.
        notes: Receives the counts.
    """
    broken = 0
    for name, values in parts.items():
        entry = SAMPLE_BUFFERS[name]
        bad = ~np.isfinite(values)
        number = int(bad.sum())
        if number:
            values[bad] = entry.no_hit
            broken += number
        outside = 0
        if entry.low is not None:
            outside += int((values < entry.low - _TOLERANCE).sum())
            np.maximum(values, np.float32(entry.low), out=values)
        if entry.high is not None:
            outside += int((values > entry.high + _TOLERANCE).sum())
            np.minimum(values, np.float32(entry.high), out=values)
        if outside:
            notes.setdefault("clipped", {})[f"samples.{name}"] = outside
    if broken:
        notes.setdefault("repaired", {})["samples"] = broken
    return Samples.of({name: parts[name] for name in SAMPLE_BUFFERS if name in parts})


def means(samples: Samples, names: Iterable[str]) -> dict[str, Image]:
    """Return the mean of each named quantity that the samples have, (H, W, c)."""
    return {name: samples.get(name).mean(0, dtype=np.float32) for name in names if name in samples.names}


def mean_variance(values: NDArray[np.float32]) -> Image:
    """Return the variance of the mean of independent samples (S, H, W, c), unbiased, 0 for one sample."""
    count = values.shape[0]
    if count < 2:
        return np.zeros(values.shape[1:], np.float32)
    return np.asarray(values.var(0, ddof=1, dtype=np.float64) / count, np.float32)


def mean_of_hits(values: NDArray[np.float32]) -> Image:
    """Return the mean over the samples that are not 0, and 0 where all are: depths, (H, W, c)."""
    hit = values > 0
    return np.asarray(values.sum(0) / np.maximum(hit.sum(0), 1), np.float32)
