"""Flips, rotations and exposure changes of training patches, and the order of the frames of a clip.

Randomness has no state: what happens to a sample is a function of (seed, epoch, sample), so that it depends
neither on the number of workers nor on where a run was interrupted.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from itertools import permutations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import HISTOGRAM, buffer

Rule = Literal["wskp", "dihedral", "none"]
Array = NDArray[np.float32]

WORLD_VECTORS = frozenset({"normal", "normal_a", "normal_b", "position", "position_a", "position_b"})
"""Vectors in world space, which turn with the axes of the world."""

WORLD_VARIANCES = frozenset({"normal_variance", "position_variance"})
"""Variances of their coordinates, which have no sign."""

ORDERS = tuple(permutations(range(3)))
"""The six orders of three channels; the first leaves them."""

IMAGE_PLANE = frozenset({"motion", "motion_a", "motion_b", "motion_variance"})
"""Vectors (x to the right, y down) that turn with the image. Normals are in world space and stay."""


class Turn(IntFlag):
    """One of the eight symmetries of a square: transpose first, then reverse rows, then columns."""

    NONE = 0
    FLIP_X = 1
    FLIP_Y = 2
    TRANSPOSE = 4


HALF_TURN = Turn.FLIP_X | Turn.FLIP_Y
LEFT = Turn.TRANSPOSE | Turn.FLIP_Y
"""A quarter turn counter-clockwise as seen on the screen, like numpy.rot90 of (H, W)."""
RIGHT = Turn.TRANSPOSE | Turn.FLIP_X
"""A quarter turn clockwise."""

_MASK = (1 << 64) - 1


def random_bits(*words: int) -> int:
    """Return 64 well mixed bits of integers, the same on every machine (SplitMix64 over the words)."""
    state = 0
    for word in words:
        state = (state + (word & _MASK) + 0x9E3779B97F4A7C15) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state


class Change(NamedTuple):
    """What happens to one sample in one epoch.

    Attributes:
        turn: Symmetry of the square.
        colors: Order of the channels of radiance and reflectance.
        axes: Order of the coordinates of world-space vectors.
        signs: Sign of each of them afterwards.
        alone: `irradiance` is that of the frame alone, without history.
    """

    turn: Turn = Turn.NONE
    colors: tuple[int, ...] = ORDERS[0]
    axes: tuple[int, ...] = ORDERS[0]
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    alone: bool = False


UNCHANGED = Change()


@dataclass(frozen=True)
class Augmentation:
    """What may happen to a training sample.

    Attributes:
        rule: `wskp`: with probability 0.5 exactly one of horizontal flip, vertical flip, quarter turn left,
            quarter turn right [authors' code of Fan et al. 2021]. `dihedral`: one of the eight symmetries of
            a square, all equally likely. `none`: nothing.
        exposure_stops: Exposure is multiplied by 2^u, u uniform in [-stops, stops].
        seed: Seed of the run.
        permute: Radiance and reflectance change the order of their channels together, as in OIDN's training;
            world-space vectors change the order and the signs of their coordinates, since no axis of the
            world means anything to a denoiser.
        drop_history: Probability with which accumulated `irradiance` is replaced by that of the frame alone,
            as at the start of a sequence and where a surface comes into view.
        samples: Fewest and most samples per pixel of a batch, where they are kept apart; drawn anew for each
            batch, and which ones for each patch. None: all of them.
        reverse: Probability with which a clip runs backward. Motion vectors would be wrong then.
        freeze: Probability with which a clip repeats one of its frames, noise included, from there to its
            end, as if the camera stopped; all but the last are equally likely. Both as Chaitanya et al. 2017
            train.
    """

    rule: Rule = "wskp"
    exposure_stops: float = 0.0
    seed: int = 0
    permute: bool = False
    drop_history: float = 0.0
    samples: tuple[int, int] | None = None
    reverse: float = 0.0
    freeze: float = 0.0

    def __post_init__(self) -> None:
        if self.rule not in ("wskp", "dihedral", "none"):
            raise ValueError(f"augmentation rule {self.rule!r}; expected wskp, dihedral or none")
        if not 0 <= self.exposure_stops <= 16:
            raise ValueError(f"exposure_stops is {self.exposure_stops}; expected 0 to 16")
        for name in ("drop_history", "reverse", "freeze"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a probability, 0 to 1")
        if self.samples is not None and not 1 <= self.samples[0] <= self.samples[-1]:
            raise ValueError(
                f"sample_counts is {list(self.samples)}; expected two numbers, 1 <= fewest <= most"
            )

    def change(self, epoch: int, sample: int) -> Change:
        """Return what is applied to the images of a sample in an epoch."""
        colors, axes, signs = ORDERS[0], ORDERS[0], (1.0, 1.0, 1.0)
        if self.permute:
            bits = random_bits(self.seed, epoch, sample, 3) >> 8
            colors, axes, octant = ORDERS[bits % 6], ORDERS[bits // 6 % 6], bits // 36
            signs = (1.0 - 2 * (octant & 1), 1.0 - (octant & 2), 1.0 - (octant & 4) / 2)
        alone = random_bits(self.seed, epoch, sample, 4) < self.drop_history * 2**64
        return Change(self.turn(epoch, sample), colors, axes, signs, alone)

    def turn(self, epoch: int, sample: int) -> Turn:
        """Return the symmetry that is applied to a sample in an epoch."""
        bits = random_bits(self.seed, epoch, sample, 1) >> 8
        if self.rule == "dihedral":
            return Turn(bits & 7)
        if self.rule == "none" or bits & 1:
            return Turn.NONE
        return (Turn.FLIP_X, Turn.FLIP_Y, LEFT, RIGHT)[(bits >> 1) & 3]

    def sample_count(self, epoch: int, sample: int, held: int) -> int:
        """Return how many of `held` samples per pixel a batch has whose first patch is `sample`."""
        if self.samples is None:
            return held
        fewest, most = (min(number, held) for number in self.samples)
        return fewest + (random_bits(self.seed, epoch, sample, 6) >> 8) % (most - fewest + 1)

    def frame_order(self, epoch: int, sample: int, frames: int) -> tuple[int, ...]:
        """Return which frame of a clip comes at each place; a clip that is reversed may be frozen too.

        Args:
            epoch: Number of the epoch.
            sample: Number of the clip.
            frames: Frames of the clip, at least 2.
        """
        order = list(range(frames))
        if random_bits(self.seed, epoch, sample, 7) < self.reverse * 2**64:
            order.reverse()
        if random_bits(self.seed, epoch, sample, 8) < self.freeze * 2**64:
            last = (random_bits(self.seed, epoch, sample, 9) >> 8) % (frames - 1)
            order[last:] = [order[last]] * (frames - last)
        return tuple(order)

    def exposure_factor(self, epoch: int, sample: int) -> float:
        """Return the factor that is applied to the sample's exposure."""
        if self.exposure_stops == 0:
            return 1.0
        unit = random_bits(self.seed, epoch, sample, 2) / 2**64
        return float(2.0 ** (self.exposure_stops * (2 * unit - 1)))


def turned(image: Array, turn: Turn) -> Array:
    """Return a view of an image (C, H, W) after a turn; no pixel is copied.

    Raises:
        ValueError: A quarter turn of an image that is not square, which would change its shape.
    """
    bits = int(turn)  # operations of enumerations cost more than these views
    if bits & 4:
        if image.shape[-1] != image.shape[-2]:
            raise ValueError(f"a quarter turn needs a square patch, got {image.shape[-1]}x{image.shape[-2]}")
        image = image.swapaxes(-1, -2)
    if bits & 2:
        image = image[..., ::-1, :]
    if bits & 1:
        image = image[..., ::-1]
    return image


def reordered(image: Array, name: str, change: Change) -> Array:
    """Return an image (C, H, W) whose channels are in the changed order; the same array if none changes."""
    if name in WORLD_VECTORS and (change.axes != ORDERS[0] or min(change.signs) < 0):
        return image[list(change.axes)] * np.asarray(change.signs, np.float32)[:, None, None]
    if name in WORLD_VARIANCES and change.axes != ORDERS[0]:
        return image[list(change.axes)]
    if change.colors != ORDERS[0] and buffer(name).letters == "RGB":
        return image[list(change.colors)]
    if change.colors != ORDERS[0] and name == HISTOGRAM:
        return image.reshape(3, -1, *image.shape[1:])[list(change.colors)].reshape(image.shape)
    return image


def turn_vectors(image: Array, turn: Turn, name: str = "motion") -> None:
    """Turn the values of image-plane vectors (2, H, W), in place; `turned` moves their pixels.

    Variances of the coordinates change places with them, but have no sign.
    """
    if turn & Turn.TRANSPOSE:
        image[:] = image[::-1].copy()
    if buffer(name).kind == "variance":
        return
    if turn & Turn.FLIP_X:
        np.negative(image[0], out=image[0])
    if turn & Turn.FLIP_Y:
        np.negative(image[1], out=image[1])
