"""Frames that show the same view: a view that is in training and in test makes scores too good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.derive import luminance
from data.frame import Frame

Plane = NDArray[np.float32]

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
