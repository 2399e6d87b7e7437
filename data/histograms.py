"""Histograms of the samples of each pixel, as ray histogram fusion compares them.

Mauricio Delbracio et al.: "Boosting Monte Carlo rendering by ray histogram fusion", ACM Transactions on
Graphics 33(1), 2014, doi:10.1145/2532708. A sample of radiance L adds 1 to the histogram of each colour
channel, split between the two bins that its place lies between:

    v = min((max(L, 0) * exposure)^(1 / 2.2) / 2.5, 2)
    v < 1:   bins floor(t) and floor(t) + 1 with the fraction of t = 18 v
    v >= 1:  the last two bins with the fraction v - 1

So 19 bins are spaced evenly up to radiance 2.5^2.2 = 7.5, and the last one tells how far beyond that a sample
lies, up to 34.5. The weight of the pixel filter is 1: samples belong to one pixel (box filter). The released
code takes radiance as it is rendered, here it is exposed first, since 7.5 means something only where scenes
are scaled alike; `trainer render stills --histogram --histogram-exposure 1` does as the code does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.buffers import HISTOGRAM_BINS

Array = NDArray[np.float32]

GAMMA = 2.2
"""Exponent of the tone curve."""

LARGEST = 2.5
"""M: after the gamma, the value where the last bin but one lies."""

SATURATION = 2.0
"""s: values over s M are taken as s M."""


def add_samples(histogram: Array, radiance: Array, exposure: float = 1.0) -> None:
    """Add samples to histograms, in place; one that is not finite in every channel does not count.

    Args:
        histogram: float32 (H, W, 60): 20 bins of red, of green, of blue; contiguous.
        radiance: Linear radiance (S, H, W, 3).
        exposure: Brings it to a displayable level.
    """
    height, width, channels = histogram.shape
    flat = histogram.reshape(-1)
    # Where the histogram of each pixel and colour starts; no place occurs twice in one sample of the image.
    first = HISTOGRAM_BINS * np.arange(height * width * (channels // HISTOGRAM_BINS))
    for sample in radiance:
        good = np.isfinite(sample).all(-1, keepdims=True)
        low, fraction = places(np.where(good, sample, 0), exposure)
        weight = np.broadcast_to(good, sample.shape).astype(np.float32).ravel()
        at, upper = first + low.ravel(), fraction.ravel() * weight
        flat[at] += weight - upper
        flat[at + 1] += upper


def places(radiance: Array, exposure: float) -> tuple[NDArray[np.int64], Array]:
    """Return the lower of the two bins of each value, 0 to 18, and the share of the upper one."""
    value = (np.maximum(radiance, 0) * np.float32(exposure)) ** np.float32(1 / GAMMA) / np.float32(LARGEST)
    value = np.minimum(value, np.float32(SATURATION))
    place = value * np.float32(HISTOGRAM_BINS - 2)
    low = np.minimum(place.astype(np.int64), HISTOGRAM_BINS - 2)
    over = (value - 1) / np.float32(SATURATION - 1)
    fraction = np.where(low < HISTOGRAM_BINS - 2, place - low, over)
    return low, np.clip(fraction, 0, 1).astype(np.float32)


def sample_histogram(radiance: Array, exposure: float = 1.0) -> Array:
    """Return the histograms (H, W, 60) of samples (S, H, W, 3); see `add_samples`."""
    histogram = np.zeros((*radiance.shape[1:3], 3 * HISTOGRAM_BINS), np.float32)
    add_samples(histogram, radiance, exposure)
    return histogram
