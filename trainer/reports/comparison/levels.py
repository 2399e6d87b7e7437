"""Radiance as integers: levels of equal steps on a logarithmic scale that passes through zero.

`q = round(sign(x) log2(1 + |x| / f) / s)` of exposed radiance x, with `f = FLOOR`, `s = 2 log2(1 + bound)`.
Since `log2(1 + |x| / f)` is off by at most s / 2, the value that is read again is off by at most
`bound (|x| + f)`: relative for what is bright, absolute in black, without a special case for zero or below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int32]
Array = NDArray[np.float32]

FLOOR = 1 / 64
"""Exposed radiance below which the error is absolute: `bound / 64` in black, where a display shows 1."""

NAN, PLUS, MINUS = 1, 2, 3
"""Marks of values that are not finite."""


@dataclass(frozen=True)
class Scale:
    """What levels mean.

    Attributes:
        bound: Largest relative error above the floor.
        exposure: The factor that radiance was multiplied by.
    """

    bound: float
    exposure: float

    @property
    def step(self) -> float:
        """Distance of two levels in powers of two."""
        return 2 * float(np.log2(1 + self.bound))


def to_planes(radiance: Array, scale: Scale) -> list[Integers]:
    """Return the levels of an image (H, W, 3) as planes G, R - G and B - G.

    A fourth plane is there where values are not finite: marks of R, 4 times those of G, 16 times those of B;
    their levels are those of zero.
    """
    marks = np.zeros(radiance.shape, np.int32)
    marks[np.isnan(radiance)] = NAN
    marks[np.isposinf(radiance)] = PLUS
    marks[np.isneginf(radiance)] = MINUS
    finite = np.where(marks == 0, radiance, 0).astype(np.float64) * scale.exposure
    logarithm = np.sign(finite) * np.log2(1 + np.abs(finite) / FLOOR)
    levels = np.rint(logarithm / scale.step).astype(np.int32)
    green = levels[..., 1]
    planes = [green, levels[..., 0] - green, levels[..., 2] - green]
    if marks.any():
        planes.append(marks @ np.array([1, 4, 16], np.int32))
    return planes


def from_planes(planes: list[Integers], scale: Scale) -> Array:
    """Return the radiance (H, W, 3) of planes, as the page shows it."""
    green = planes[0]
    levels = np.stack([green + planes[1], green, green + planes[2]], -1)
    size = FLOOR * (np.exp2(np.abs(levels) * scale.step) - 1) / scale.exposure
    radiance = (np.sign(levels) * size).astype(np.float32)
    if len(planes) > 3:
        marks = (planes[3][..., None] // np.array([1, 4, 16])) % 4
        for mark, value in ((NAN, np.nan), (PLUS, np.inf), (MINUS, -np.inf)):
            radiance[marks == mark] = value
    return radiance
