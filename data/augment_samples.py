"""Flips, rotations and permutations of samples that are kept apart, and random subsets of them.

What lies in the image plane turns with the image: motion (x to the right, y down), positions on the lens (x
to the left, y up, as Mitsuba's cameras have it), positions within the pixel. Normals turn as vectors of the
view do (x to the right, y up). For normals and positions in world space that is exact as well: the changed
frame shows the mirrored scene in a world whose axes lie otherwise, which means nothing to a denoiser.

The authors of the layer method, whose normals are in view space (as the layouts `layerdenoise` and `sbmc` say
of theirs), turn normals alone; motion and lens stay as they are in their code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.augment import ORDERS, Array, Change, Turn, random_bits, turned
from data.buffers import SAMPLE_BUFFERS

WORLD = frozenset({"normal", "first_normal", "position"})
"""Vectors whose x and y turn with the image and whose axes are permuted."""

PLANE = frozenset({"motion", "lens"})
"""Vectors in the image plane."""

WITHIN = frozenset({"offset"})
"""Positions within the pixel, from 0 to 1."""

UNTURNED = frozenset({"light_direction"})
"""Angles, of which no file says to which axes they belong."""


class Moves(NamedTuple):
    """Where each channel comes from: channel `source` times `scale` plus `shift`."""

    source: NDArray[np.intp]
    scale: NDArray[np.float32]
    shift: NDArray[np.float32]


def moves(channels: Sequence[str], change: Change) -> Moves:
    """Return what happens to the channels of samples, beside the turn of the pixels.

    Args:
        channels: Such as `radiance.R`.
        change: Turn, order of colours, order and signs of axes.

    Raises:
        ValueError: A channel would have to turn and it is not known how.
    """
    count = len(channels)
    made = Moves(np.arange(count), np.ones(count, np.float32), np.zeros(count, np.float32))
    for name in dict.fromkeys(channel.partition(".")[0] for channel in channels):
        first = channels.index(f"{name}.{SAMPLE_BUFFERS[name].letters[0]}")
        part = slice(first, first + len(SAMPLE_BUFFERS[name].letters))
        if name in UNTURNED and (
            change.turn != Turn.NONE or change.axes != ORDERS[0] or min(change.signs) < 0
        ):
            raise ValueError(
                f"samples with {name} are not flipped, rotated or permuted: use --data.augment false"
            )
        if name in WORLD | PLANE | WITHIN:
            _turn(made, part.start, change.turn, name)
        if name in WORLD:
            _permute(made, part, change.axes)
            made.scale[part] *= change.signs
        elif SAMPLE_BUFFERS[name].letters == tuple("RGB"):
            _permute(made, part, change.colors)
    return made


def changed(samples: Array, channels: Sequence[str], change: Change, out: Array) -> None:
    """Write samples (S, C, H, W) after a change into `out` of the same shape."""
    source, scale, shift = moves(channels, change)
    for place in range(len(channels)):
        image = turned(samples[:, source[place]], change.turn)
        np.multiply(image, scale[place], out=out[:, place])
        if shift[place]:
            out[:, place] += shift[place]


def subset(held: int, count: int, seed: int, epoch: int, sample: int) -> list[int]:
    """Return `count` of `held` samples, in an order of chance that follows from the numbers."""
    left = list(range(held))
    return [left.pop(random_bits(seed, epoch, sample, 5, i) % len(left)) for i in range(count)]


def _turn(made: Moves, x: int, turn: Turn, name: str) -> None:
    y, one = x + 1, np.float32(1)
    if turn & Turn.TRANSPOSE:
        made.source[[x, y]] = made.source[[y, x]]
        if name in WORLD:  # y is up, and rows count downwards
            made.scale[[x, y]] = -one
    for place, flip in ((x, Turn.FLIP_X), (y, Turn.FLIP_Y)):
        if turn & flip:
            made.scale[place] *= -one
            made.shift[place] = one if name in WITHIN else 0


def _permute(made: Moves, part: slice, order: Sequence[int]) -> None:
    for values in made:
        values[part] = values[part][list(order)]
