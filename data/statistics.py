"""Numbers of a frame that tell whether it is fit for training: fireflies, histograms, energy, likeness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import buffer
from data.derive import luminance
from data.frame import Frame, Image

Counts = NDArray[np.int64]
Plane = NDArray[np.float32]

FIREFLY_FACTOR = 10.0
"""A firefly is so many times as bright as its reference."""

FIREFLY_FLOOR = 0.1
"""Share of the reference's median luminance that is added to the reference, for dark places."""

GRID = (24, 16)
"""Columns and rows of a fingerprint, whatever the size of the frame."""

LIGHT_FLOOR, NORMAL_FLOOR = 0.1, 0.05
"""Differences that count as nothing: in doublings of luminance, and in the length of a normal. They keep two
featureless frames from being told apart by their noise."""

SAME_LIGHT, SAME_NORMAL = 0.9, 0.97
"""Likeness from which two frames count as the same view. A frame with one sample per pixel has 0.94 and more
with its own reference; cameras that are 8 degrees apart have less than 0.8."""

SAME_GEOMETRY = 0.99
"""Likeness of normals from which two frames count as the same geometry, though light or materials differ."""

FLAT = 0.01
"""Variance of the normals below which a view has no geometry that it could share with another."""


BLOCK = 256
"""Fingerprints that are compared with all others at one time, which bounds the memory."""


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


@dataclass(frozen=True)
class Fingerprint:
    """What a view looks like, coarse enough to be free of noise.

    Attributes:
        light: log2 of the mean luminance of each cell without its mean, so that exposure does not matter,
            float32 (16, 24).
        normal: Mean normal of each cell, float32 (16, 24, 3), None where the frame has none.
    """

    light: Plane
    normal: Plane | None = None


def fingerprint(frame: Frame) -> Fingerprint | None:
    """Return the fingerprint of a frame, from `reference` rather than `color`; None if it has neither.

    Luminance is cut off at 16 times its mean, so that a firefly does not light up a cell.
    """
    name = next((n for n in ("reference", "color") if n in frame.buffers), None)
    if name is None:
        return None
    light = np.maximum(luminance(frame.buffers[name]), 0)
    mean = float(light.mean(dtype=np.float64))
    scale = mean if mean > 0 else 1.0
    cells = box_mean(np.minimum(light / scale, 16)[..., None])[..., 0]
    # Two hundredths of the mean hide what is darker than anybody would see, and its noise with it.
    log = np.log2(cells + 0.02)
    normal = frame.buffers.get("normal")
    return Fingerprint(
        (log - log.mean()).astype(np.float32),
        None if normal is None else box_mean(normal).astype(np.float32),
    )


def box_mean(image: NDArray[np.float32], size: tuple[int, int] = GRID) -> NDArray[np.float64]:
    """Return exact means over the cells of a grid, (rows, columns, C); cells may end within a pixel.

    Args:
        image: Values (H, W, C).
        size: Columns and rows.
    """
    result = image.astype(np.float64)
    for axis, cells in ((0, size[1]), (1, size[0])):
        length = result.shape[axis]
        sums = np.concatenate([np.zeros_like(result.take([0], axis)), result.cumsum(axis)], axis)
        edges = np.linspace(0, length, cells + 1)
        left = np.minimum(edges.astype(np.intp), length - 1)
        part = np.expand_dims(edges - left, tuple(i for i in range(3) if i != axis))
        at_edges = sums.take(left, axis) * (1 - part) + sums.take(left + 1, axis) * part
        result = np.diff(at_edges, axis=axis) * (cells / length)
    return result


class Pair(NamedTuple):
    """Two frames that look alike: their places in the list, and how alike (1: equal).

    Attributes:
        first: Place of one frame.
        second: Place of the other, larger.
        light: Likeness of their luminance.
        normal: Likeness of their normals, NaN where one has none.
    """

    first: int
    second: int
    light: float
    normal: float

    @property
    def same_view(self) -> bool:
        """Luminance is alike too; otherwise the pair has geometry and camera in common."""
        return self.light >= SAME_LIGHT


def near_duplicates(prints: Sequence[Fingerprint | None], scenes: Sequence[str]) -> list[Pair]:
    """Return pairs of frames of different scenes that show the same view, the most alike first.

    Likeness is `1 - |a - b|^2 / (|a|^2 + |b|^2 + n floor^2)` over the n numbers of two fingerprints: 1 for
    equal ones, about 0 for unrelated ones.

    Args:
        prints: One per frame, None for frames that have none.
        scenes: Scene of each frame; frames of one scene are never a pair.
    """
    known = [i for i, p in enumerate(prints) if p is not None]
    if len(known) < 2:
        return []
    names = np.array([scenes[i] for i in known])
    lights = _stack([prints[i] for i in known], "light")
    normals = _stack([prints[i] for i in known], "normal")
    shaped = normals.reshape(len(known), -1, 3).var(1).sum(1) > FLAT
    pairs = []
    for start in range(0, len(known), BLOCK):
        part = slice(start, start + BLOCK)
        light = _likeness(lights[part], lights, LIGHT_FLOOR)
        normal = _likeness(normals[part], normals, NORMAL_FLOOR)
        geometry = (normal >= SAME_GEOMETRY) & shaped[part, None] & shaped[None, :]
        view = (light >= SAME_LIGHT) & ((normal >= SAME_NORMAL) | np.isnan(normal))
        alike = (view | geometry) & (names[part, None] != names[None, :])
        for i, j in np.argwhere(alike).tolist():
            if j > start + i:
                pairs.append(Pair(known[start + i], known[j], float(light[i, j]), float(normal[i, j])))
    return sorted(pairs, key=lambda p: -p.light)


def _stack(prints: list[Fingerprint | None], part: str) -> NDArray[np.float64]:
    """Return one part of each fingerprint as a row, NaN where it is absent."""
    size = GRID[0] * GRID[1] * (3 if part == "normal" else 1)
    rows = []
    for print_ in prints:
        values = getattr(print_, part)
        rows.append(np.full(size, np.nan) if values is None else values.reshape(-1))
    return np.stack(rows).astype(np.float64)


def _likeness(rows: NDArray[np.float64], others: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Return the likeness of each row with each other one (N, M), NaN where one holds NaN."""
    total = (rows**2).sum(1)[:, None] + (others**2).sum(1)[None, :]
    noise = rows.shape[1] * floor**2
    return 1 - np.maximum(total - 2 * rows @ others.T, 0) / (total + noise)
