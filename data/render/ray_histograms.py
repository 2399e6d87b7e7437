"""Histograms of the traced samples of each pixel, at several counts of one stream."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from data.buffers import HISTOGRAM_BINS
from data.histograms import Array, add_samples


class RayHistograms:
    """Histograms after each of several numbers of samples.

    Args:
        counts: Samples per pixel, ascending.
        size: Height and width of the image.
        exposure: Brings radiance to a displayable level.
    """

    def __init__(self, counts: tuple[int, ...], size: tuple[int, int], exposure: float) -> None:
        self.exposure = exposure
        self._parts = list(pairwise((0, *counts)))
        shape = (*size, 3 * HISTOGRAM_BINS)
        self._added: dict[int, Array] = {last: np.zeros(shape, np.float32) for last in counts}
        self._seen: dict[int, int] = {}
        self._total = np.zeros(shape, np.float32)

    def add(self, rows: slice, radiance: NDArray[np.float32]) -> None:
        """Add samples (S, h, W, 3) of some rows; all samples of a band of rows come in order."""
        before = self._seen.get(rows.start, 0)
        after = self._seen[rows.start] = before + len(radiance)
        for first, last in self._parts:
            part = radiance[max(first, before) - before : max(min(last, after) - before, 0)]
            if len(part):
                add_samples(self._added[last][rows], part, self.exposure)

    def take(self, count: int) -> Array:
        """Return the histograms (H, W, 60) of the first `count` samples; counts are taken in order."""
        self._total += self._added.pop(count)
        return self._total if not self._added else self._total.copy()
