"""Where training patches are cut from frames: uniform positions of a fixed density.

Positions that follow what is in the frame are in `data.importance`.

The published protocol [Fan et al. 2021, section 5] takes 80 training and 20 validation patches of 128x128
from each 1280x720 frame. Other frame sizes keep the number per area; where that is not whole, numbers of
successive frames differ by one so that their average is exact.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from data.frame import Image

REFERENCE_AREA = 1280 * 720
"""Pixels of the frame that patch counts refer to."""

LEGACY_TRAIN = 77
"""Training crops per 1280x720 frame in the authors' script, where the paper says 80."""


class Position(NamedTuple):
    """Column and row of a patch's top left pixel; negative only for legacy crops, which reach into
    padding."""

    x: int
    y: int


def patch_count(per_reference: int, width: int, height: int, ordinal: int) -> int:
    """Return how many patches the `ordinal`-th frame of a scene gives (ordinal from 0).

    Args:
        per_reference: Number for a 1280x720 frame; 0 gives 0.
        width: Columns of the frame.
        height: Rows of the frame.
        ordinal: Place of the frame in its scene. Counts of the first n frames sum to floor(n * density), or
            to n where the density is below one.

    Returns:
        At least 1, unless `per_reference` is 0.
    """
    if per_reference < 0:
        raise ValueError(f"number of patches per frame is {per_reference}; expected 0 or more")
    if per_reference == 0:
        return 0
    density = Fraction(per_reference * width * height, REFERENCE_AREA)
    return max(1, math.floor((ordinal + 1) * density) - math.floor(ordinal * density))


def check_size(size: tuple[int, int], patch: int, label: str = "frame") -> None:
    """Check that a frame of this width and height holds a patch.

    Raises:
        ValueError: It does not; names frame, size and option.
    """
    width, height = size
    if width < patch or height < patch:
        raise ValueError(
            f"{label} is {width}x{height}, smaller than a patch of {patch}x{patch}; "
            f"use --patch-size {min(width, height)} or less"
        )


def generator_of(seed: tuple[int | str, ...]) -> np.random.Generator:
    """Return a generator for whatever tells one draw from others, the same on every machine."""
    words = "\0".join(map(str, seed)).encode()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(list(words))))


def uniform_positions(
    count: int, size: tuple[int, int], patch: int, seed: tuple[int | str, ...], label: str = "frame"
) -> list[Position]:
    """Return uniformly distributed positions of patches that lie inside the frame.

    Args:
        count: Number of patches; they are independent, so they may overlap.
        size: Width and height of the frame.
        patch: Width and height of a patch.
        seed: Whatever tells this draw from others: global seed, split, scene, frame. The same seed gives the
            same positions on every machine.
        label: Name of the frame, for the error.

    Raises:
        ValueError: The frame is smaller than a patch.
    """
    check_size(size, patch, label)
    width, height = size
    return _draw(count, (0, width - patch + 1), (0, height - patch + 1), seed)


def legacy_positions(
    count: int, size: tuple[int, int], patch: int, seed: tuple[int | str, ...], label: str = "frame"
) -> list[Position]:
    """Return positions as the authors' script of WSKP draws them (option `wskp_legacy_crops`).

    The script pads frames by `patch` zeros on every side and draws the corner, in padded pixels, from
    [0, size - 2 * patch): crops reach into the padding and never see the right and bottom of the frame.
    Arguments and result are those of `uniform_positions`; cut them with `cut`, which pads.

    Raises:
        ValueError: The frame is not larger than two patches, for which the script's range is empty.
    """
    width, height = size
    if width <= 2 * patch or height <= 2 * patch:
        raise ValueError(
            f"{label} is {width}x{height}; legacy crops need frames larger than two patches, "
            f"{2 * patch}x{2 * patch}: leave out --wskp-legacy-crops or use a smaller --patch-size"
        )
    return _draw(count, (-patch, width - 3 * patch), (-patch, height - 3 * patch), seed)


def cut(image: Image, position: Position, patch: int) -> Image:
    """Return a patch (patch, patch, C) of an image (H, W, C), with zeros outside of the image."""
    height, width = image.shape[:2]
    x, y = position
    if x >= 0 and y >= 0 and x + patch <= width and y + patch <= height:
        return image[y : y + patch, x : x + patch]
    result = np.zeros((patch, patch, image.shape[2]), image.dtype)
    top, left, bottom, right = max(y, 0), max(x, 0), min(y + patch, height), min(x + patch, width)
    if bottom > top and right > left:
        result[top - y : bottom - y, left - x : right - x] = image[top:bottom, left:right]
    return result


def _draw(
    count: int, columns: tuple[int, int], rows: tuple[int, int], seed: tuple[int | str, ...]
) -> list[Position]:
    generator = generator_of(seed)
    xs = generator.integers(*columns, size=count)
    ys = generator.integers(*rows, size=count)
    return [Position(int(x), int(y)) for x, y in zip(xs, ys, strict=True)]
