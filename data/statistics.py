"""Numbers of a frame that tell whether it is fit for training: fireflies, histograms, energy, ranges."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import buffer
from data.derive import luminance
from data.frame import Frame, Image

Counts = NDArray[np.int64]

FIREFLY_FACTOR = 10.0
"""A firefly is so many times as bright as its reference."""

FIREFLY_FLOOR = 0.1
"""Share of the reference's median luminance that is added to the reference, for dark places."""


@dataclass(frozen=True)
class Scale:
    """Bins of a histogram, of equal width between `low` and `high`.

    Attributes:
        low: Left edge of the first bin, the exponent of ten where `logarithmic`.
        high: Right edge of the last bin.
        bins: Number of bins.
        logarithmic: Bins are equally wide in the decimal logarithm of a value.
    """

    low: float
    high: float
    bins: int
    logarithmic: bool = False


RADIANCE, DISTANCE = Scale(-4, 4, 80, True), Scale(-3, 5, 80, True)
ALBEDO, LENGTH = Scale(0, 1, 50), Scale(0, 1.2, 60)


@dataclass
class Histogram:
    """Numbers of values in bins that are the same for all frames, so that frames can be added up.

    Attributes:
        scale: The bins.
        counts: Values in each bin (bins,).
        below: Values below the first bin other than 0.
        above: Values above the last bin.
        zero: Values of exactly 0, where the bins are logarithmic.
    """

    scale: Scale
    counts: Counts = field(default_factory=lambda: np.zeros(0, np.int64))
    below: int = 0
    above: int = 0
    zero: int = 0

    def __post_init__(self) -> None:
        if self.counts.size == 0:
            self.counts = np.zeros(self.scale.bins, np.int64)

    @property
    def total(self) -> int:
        """Number of values, those outside of the bins included."""
        return int(self.counts.sum()) + self.below + self.above + self.zero

    def __add__(self, other: Histogram) -> Histogram:
        if self.scale != other.scale:
            raise ValueError(f"histograms with the bins {self.scale} and {other.scale} cannot be added")
        return Histogram(
            self.scale,
            self.counts + other.counts,
            self.below + other.below,
            self.above + other.above,
            self.zero + other.zero,
        )


def histogram(values: NDArray[np.float32], scale: Scale) -> Histogram:
    """Count values of any shape; those that are not finite are left out, negative ones are `below`."""
    values = values[np.isfinite(values)].astype(np.float64)
    zero = 0
    below = 0
    if scale.logarithmic:
        positive = values[values > 0]
        zero = int((values == 0).sum())
        below = values.size - zero - positive.size
        values = np.log10(positive)
    place = np.floor((values - scale.low) * (scale.bins / (scale.high - scale.low)))
    place[values == scale.high] = scale.bins - 1
    inside = place[(place >= 0) & (place < scale.bins)].astype(np.int64)
    counts = np.bincount(inside, minlength=scale.bins).astype(np.int64)
    below += int((place < 0).sum())
    return Histogram(scale, counts, below, int((place >= scale.bins).sum()), zero)


def histograms(frame: Frame) -> dict[str, Histogram]:
    """Return what can be counted: luminance of `color` and `reference`, `depth`, albedo, length of normals.

    Luminance is in the units of the file, without exposure. Pixels without a hit are left out of depth and
    length.
    """
    b = frame.buffers
    found: dict[str, Histogram] = {}
    for name in ("color", "reference"):
        if name in b:
            found[name] = histogram(luminance(b[name]), RADIANCE)
    if "depth" in b:
        found["depth"] = histogram(b["depth"][b["depth"] != 0], DISTANCE)
    for name in ("albedo", "diffuse_albedo", "specular_albedo"):
        if name in b:
            found[name] = histogram(b[name], ALBEDO)
    if "normal" in b:
        length = np.linalg.norm(b["normal"], axis=-1)
        found["normal"] = histogram(length[length > 0], LENGTH)
    return found


def firefly_mask(color: Image, reference: Image) -> NDArray[np.bool_]:
    """Return where a pixel is a firefly, (H, W): `L > 10 (L_r + 0.1 median(L_r))`.

    L and L_r are Rec. 709 luminances of the noisy and of the converged radiance (H, W, 3).
    """
    light, true = luminance(color), luminance(reference)
    return np.asarray(light > FIREFLY_FACTOR * (true + FIREFLY_FLOOR * np.median(true)))


def no_hit_share(frame: Frame) -> float | None:
    """Return which fraction of the samples left the scene, None where nothing tells.

    From `hit` where there is one, otherwise the share of pixels whose depth, position or normal is that of a
    ray without a hit.
    """
    if "hit" in frame.buffers:
        return float(1 - frame.buffers["hit"].mean(dtype=np.float64))
    for name in ("depth", "position", "normal"):
        if name in frame.buffers:
            return float((frame.buffers[name] == buffer(name).no_hit).all(-1).mean())
    return None


def outside_share(name: str, image: Image, slack: float = 1e-3) -> float:
    """Return which fraction of the values lies outside of the buffer's legal range.

    A radiance buffer may hold anything from 0; albedo of any kind is judged by [0, 1].

    Args:
        name: Word of the vocabulary.
        image: Values (H, W, C).
        slack: By how much a value may pass the limits, for rounding.
    """
    entry = buffer(name)
    bad = np.zeros(image.shape, bool)
    high = 1.0 if name == "albedo" else entry.high
    if entry.low is not None:
        bad |= image < entry.low - slack * (entry.high is not None)
    if high is not None:
        bad |= image > high + slack
    return float(bad.mean())


class Energy(NamedTuple):
    """Mean radiance of the input against that of the reference.

    Attributes:
        ratio: Mean of the input divided by that of the reference, over pixels and channels.
        z: The largest deviation of a channel's mean in standard errors, with its sign; None where the
            variance is unknown.
    """

    ratio: float
    z: float | None


def energy(frame: Frame, reference_spp: int | None = None) -> Energy | None:
    """Return the comparison of `color` and `reference`, None where one is absent or the reference is black.

    The standard error follows from `color_variance`; the reference adds `spp / reference_spp` of it where
    both numbers are known, and is taken as exact otherwise.
    """
    b = frame.buffers
    if not {"color", "reference"} <= b.keys():
        return None
    color, true = (b[n].reshape(-1, 3).mean(0, dtype=np.float64) for n in ("color", "reference"))
    if not true.sum() > 0:
        return None
    ratio = float(color.sum() / true.sum())
    if "color_variance" not in b:
        return Energy(ratio, None)
    variance = b["color_variance"].reshape(-1, 3).sum(0, dtype=np.float64) / (frame.height * frame.width) ** 2
    if frame.spp and reference_spp:
        variance = variance * (1 + frame.spp / reference_spp)
    known = variance > 0
    if not known.any():
        return Energy(ratio, None)
    scores = (color - true)[known] / np.sqrt(variance[known])
    return Energy(ratio, float(scores[np.abs(scores).argmax()]))
