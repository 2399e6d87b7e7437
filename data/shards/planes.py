"""The buffers of a frame as shards hold them: channel first, in half precision where that is enough.

A frame is converted once, and patches are copied out of it; each patch decides for itself whether half
precision holds it, so that a firefly elsewhere in the frame costs nothing.

Samples that do not count stay NaN, in half precision as well: who reads a batch leaves them out, as in frames
(`data.dropped`). Another sample of the pixel in their place would count twice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import SAMPLE_BUFFERS, SAMPLES, buffer
from data.dropped import require_marked
from data.frame import Image, Samples
from data.patches import Position
from data.repair import all_finite

HALF_MAX = 65504.0
HALF_FLOOR = 2.0**-8
"""Arrays that are not zero but nowhere exceed this are kept in float32: half precision would have fewer than
its 11 bits for values 1/64 of the largest and smaller."""

_FLOOR = int(np.float16(HALF_FLOOR).view(np.uint16))

Stored = NDArray[Any]
"""float16 or float32, little-endian, channels before rows and columns."""


def half_fits(name: str, array: Image) -> bool:
    """Return whether an array of the named buffer is stored in half precision.

    It is if the vocabulary allows it, its largest magnitude is at most 65504, and not so small that the array
    would lie among the subnormal numbers.
    """
    return buffer(name).half and _in_range(array)


class Planes:
    """One buffer of a frame, ready to be cut.

    Args:
        name: The buffer, for messages.
        values: float32 (C, H, W), or (S, C, H, W) of samples, in any memory order; or float16, as it is
            stored.
        half: Half precision is allowed.
        gaps: NaN is allowed, infinity is not.

    Raises:
        ValueError: A value is not finite; names the buffer.
    """

    def __init__(self, name: str, values: NDArray[Any], half: bool, gaps: bool = False) -> None:
        self._gaps = not all_finite(values)
        if self._gaps and not (gaps and not np.isinf(values).any()):
            raise ValueError(
                f"buffer {name!r} has values that are not finite; ingest repairs them: trainer ingest"
            )
        self.values = values
        self._half: NDArray[np.float16] | None = None
        self._all_in_range = True
        if values.dtype == np.float16:
            self._half = values
        elif half:
            self._all_in_range = _largest(values) <= HALF_MAX
            with np.errstate(over="ignore"):  # a patch with such a value is taken from `values`
                self._half = values.astype("<f2", order="C")

    @staticmethod
    def of(name: str, image: Image) -> Planes:
        """Return the planes of a buffer (H, W, C)."""
        return Planes(name, image.transpose(2, 0, 1), buffer(name).half)

    @staticmethod
    def of_samples(samples: Samples, half: bool) -> Planes:
        """Return the planes of samples.

        Args:
            samples: The samples of a frame.
            half: In half precision whatever they are, radiance clipped to [0, 65504]; otherwise only where it
                is precise enough for every quantity. Patches with larger numbers, and frames whose depths are
                too small for it, are kept in float32 anyway.

        Raises:
            ValueError: A value is not finite, in a sample that is not marked as dropped.
        """
        require_marked(samples.values, samples.channels)
        values = np.ascontiguousarray(samples.values.transpose(0, 3, 1, 2))
        if half and "radiance" in samples.names:
            first = samples.channels.index("radiance.R")
            np.clip(values[:, first : first + 3], 0, HALF_MAX, out=values[:, first : first + 3])
        wide = [samples.get(name) for name in samples.names if not SAMPLE_BUFFERS[name].half]
        halves = all(half and not 0 < _largest(quantity) < HALF_FLOOR for quantity in wide)
        return Planes(SAMPLES, values, halves, gaps=True)

    def cut(self, position: Position | None, patch: int) -> Stored:
        """Return a patch in the type in which it is stored, a view where it lies inside; None: everything.

        Outside of the frame a patch is 0.
        """
        if self._half is None:
            return _window(self.values, position, patch)
        half = _window(self._half, position, patch)
        # Most often one pixel tells that the patch is not among the subnormal numbers.
        middle = half[..., half.shape[-2] // 2, half.shape[-1] // 2]
        if self._all_in_range and not self._gaps and _magnitude(middle) >= _FLOOR:
            return half
        if self.values is self._half:
            largest = _magnitude(half)
            return half if largest == 0 or largest >= _FLOOR else half.astype(np.float32)
        values = _window(self.values, position, patch)
        return half if _in_range(values) else values

    def black(self, position: Position, patch: int) -> bool:
        """Return whether a patch is 0 everywhere."""
        values = _window(self.values, position, patch)
        if values.dtype == np.float16:
            return _magnitude(values[..., values.shape[-2] // 2, :]) == 0 and _magnitude(values) == 0
        return not (values[..., values.shape[-2] // 2, :].any() or values.any())


def _in_range(array: NDArray[np.float32]) -> bool:
    largest = _largest(array)
    return largest == 0.0 or HALF_FLOOR <= largest <= HALF_MAX


def _largest(array: NDArray[np.float32]) -> float:
    """Return the largest magnitude, NaN left out."""
    largest = max(float(array.max(initial=0)), -float(array.min(initial=0)))
    return largest if largest == largest else float(np.fmax.reduce(np.abs(array), axis=None, initial=0))


def _magnitude(array: NDArray[np.float16]) -> int:
    """Return the bits of the largest magnitude, which order as the numbers do."""
    return int((array.view(np.uint16) & 0x7FFF).max(initial=0))


def _window(array: Stored, position: Position | None, patch: int) -> Stored:
    if position is None:
        return array
    height, width = array.shape[-2:]
    x, y = position
    if x >= 0 and y >= 0 and x + patch <= width and y + patch <= height:
        return array[..., y : y + patch, x : x + patch]
    result = np.zeros((*array.shape[:-2], patch, patch), array.dtype)
    top, left, bottom, right = max(y, 0), max(x, 0), min(y + patch, height), min(x + patch, width)
    if bottom > top and right > left:
        result[..., top - y : bottom - y, left - x : right - x] = array[..., top:bottom, left:right]
    return result
