"""What happens to NaN, infinities and pixels without data: a stated policy per buffer, counted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import buffer
from data.frame import Image

_INTEGERS = {2: (np.int16, np.uint16), 4: (np.int32, np.uint32)}
"""Signed and unsigned type of as many bytes."""


def finite_mask(image: Image) -> NDArray[np.bool_]:
    """Return where all channels of a pixel are finite, (H, W)."""
    return np.asarray(np.isfinite(image).all(axis=-1))


def all_finite(array: NDArray[Any]) -> bool:
    """Return whether no value of a float16 or float32 array is NaN or infinite.

    Such values have all bits of the exponent set. Read as integers they are the largest of their sign, so two
    maxima tell; that is several times faster than `isfinite`, which makes a mask.
    """
    if array.dtype not in (np.float16, np.float32):
        return bool(np.isfinite(array).all())
    signed, unsigned = _INTEGERS[array.dtype.itemsize]
    infinity = int(array.dtype.type(np.inf).view(unsigned))
    negative = int(array.dtype.type(-np.inf).view(unsigned))
    positive_fine = int(array.view(signed).max(initial=0)) < infinity
    return positive_fine and int(array.view(unsigned).max(initial=0)) < negative


def repair(buffers: Mapping[str, Image]) -> tuple[dict[str, Image], dict[str, int]]:
    """Replace non-finite pixels by each buffer's policy.

    `Buffer.repair` says which: `neighbours` is the mean of the finite pixels among the 3x3 neighbours, of the
    unrepaired image, and 0 where none is finite; `no_hit` is the buffer's value of a pixel that hit nothing.
    A pixel is replaced in all its channels, so that no colour is invented from a broken sample.

    Args:
        buffers: Name of the vocabulary → float32 (H, W, C).

    Returns:
        The repaired buffers (untouched arrays are passed on) and the number of replaced pixels per buffer,
        buffers without any left out.
    """
    repaired, counts = {}, {}
    for name, image in buffers.items():
        if all_finite(image):
            repaired[name] = image
            continue
        bad = ~finite_mask(image)
        number = int(bad.sum())
        repaired[name], counts[name] = _replace(image, bad, name), number
    return repaired, counts


def _replace(image: Image, bad: NDArray[np.bool_], name: str) -> Image:
    entry = buffer(name)
    result = image.copy()
    result[bad] = neighbour_mean(image, bad) if entry.repair == "neighbours" else entry.no_hit
    return result


def neighbour_mean(image: Image, bad: NDArray[np.bool_]) -> Image:
    """Return, for each bad pixel, the mean of its good 3x3 neighbours (N, C), 0 where there is none."""
    height, width = bad.shape
    rows, columns = np.nonzero(bad)
    total = np.zeros((len(rows), image.shape[2]), np.float64)
    number = np.zeros((len(rows), 1))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y, x = rows + dy, columns + dx
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            y, x = y.clip(0, height - 1), x.clip(0, width - 1)
            good = (inside & ~bad[y, x])[:, None]
            total += np.where(good, image[y, x], 0.0)
            number += good
    return (total / np.maximum(number, 1)).astype(np.float32)
