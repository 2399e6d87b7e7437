"""Running sums of a stream of samples: means, half buffers and variances of the mean at several counts.

Samples arrive a few per pixel at a time, in bands of rows where an image is large. Sums are float64, so that
the variance `(sum of squares - sum^2 / n) / (n - 1) / n` keeps its digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass
class Moments:
    """What is known of one quantity after `count` samples per pixel.

    Attributes:
        count: Samples per pixel.
        even: Sum of the samples 0, 2, 4 … (H, W, C), float64.
        odd: Sum of the samples 1, 3, 5 …
        squares: Sum of squares of all samples.
    """

    count: int
    even: NDArray[np.float64]
    odd: NDArray[np.float64]
    squares: NDArray[np.float64]

    @staticmethod
    def zero(height: int, width: int, channels: int) -> Moments:
        """Return the sums before the first sample."""
        shape = (height, width, channels)
        return Moments(0, np.zeros(shape), np.zeros(shape), np.zeros(shape))

    def add(self, values: Array) -> None:
        """Add samples (S, H, W, C)."""
        first = self.count % 2
        self.even += values[first::2].sum(0, dtype=np.float64)
        self.odd += values[1 - first :: 2].sum(0, dtype=np.float64)
        self.squares += np.einsum("shwc,shwc->hwc", values, values, dtype=np.float64)
        self.count += len(values)

    def mean(self) -> Array:
        """Return the mean (H, W, C)."""
        return ((self.even + self.odd) / self.count).astype(np.float32)

    def half(self, which: str) -> Array:
        """Return the mean of the samples of half `a` (even) or `b` (odd); needs two samples."""
        total, number = (self.even, -(-self.count // 2)) if which == "a" else (self.odd, self.count // 2)
        return (total / number).astype(np.float32)

    def variance(self) -> Array:
        """Return the unbiased variance of the mean (H, W, C); needs two samples."""
        total = self.even + self.odd
        spread = np.maximum(self.squares - total * total / self.count, 0)
        return (spread / (self.count - 1) / self.count).astype(np.float32)


def over_hits(moments: Moments, hits: Moments) -> Array:
    """Return the mean of a quantity over the samples that hit something, 0 where none did.

    A depth or position averaged with the zeros of rays that missed would lie on no surface.
    """
    number = hits.even + hits.odd
    total = moments.even + moments.odd
    return np.where(number > 0, total / np.maximum(number, 1), 0).astype(np.float32)


def at_counts(
    chunks: Iterator[tuple[slice, Mapping[str, Array]]], counts: tuple[int, ...], size: tuple[int, int]
) -> Iterator[tuple[int, dict[str, Moments]]]:
    """Sum a stream of samples and yield the sums of the whole image whenever a wanted count is reached.

    Args:
        chunks: Rows and name → samples (S, h, W, C); either all rows each time, or band after band, each
            with all its samples.
        counts: Wanted samples per pixel, ascending.
        size: Height and width of the image.

    Raises:
        ValueError: The stream ended before the last count was reached.
    """
    (height, width), last = size, counts[-1]
    bands: dict[int, dict[str, Moments]] = {}
    finished: dict[int, dict[int, dict[str, Moments]]] = {count: {} for count in counts}
    for rows, values in chunks:
        done = 0
        number = len(next(iter(values.values())))
        band = bands.setdefault(
            rows.start, {n: Moments.zero(v.shape[1], width, v.shape[3]) for n, v in values.items()}
        )
        while done < number:
            before = next(iter(band.values())).count
            step = min([number - done, *(c - before for c in counts if c > before)])
            for name, moments in band.items():
                moments.add(values[name][done : done + step])
            done += step
            if before + step in finished:
                # Nothing is added to the sums of the last count, so that they need no copy.
                whole = before + step == last
                finished[before + step][rows.start] = {n: m if whole else _copy(m) for n, m in band.items()}
        for count in counts:
            if sum(_rows(band) for band in finished[count].values()) == height:
                yield count, _joined(finished.pop(count))
                counts = tuple(c for c in counts if c != count)
    if counts:
        raise ValueError(f"the renderer gave fewer than {counts[-1]} samples per pixel")


def _rows(band: dict[str, Moments]) -> int:
    return next(iter(band.values())).even.shape[0]


def _copy(moments: Moments) -> Moments:
    return Moments(moments.count, moments.even.copy(), moments.odd.copy(), moments.squares.copy())


def _joined(bands: dict[int, dict[str, Moments]]) -> dict[str, Moments]:
    """Return the sums of the whole image; the bands' own are given up one by one, to save memory."""
    parts = [bands[start] for start in sorted(bands)]
    if len(parts) == 1:
        return parts[0]
    result = {}
    for name in list(parts[0]):
        moments = [part.pop(name) for part in parts]
        result[name] = Moments(
            moments[0].count,
            np.concatenate([m.even for m in moments]),
            np.concatenate([m.odd for m in moments]),
            np.concatenate([m.squares for m in moments]),
        )
    return result
