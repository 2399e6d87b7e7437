"""Temporal accumulation by reprojection, as WSKP and BMFR do it.

A pixel's world position is projected with the camera of the preceding frame; of the four bilinear neighbours
there, those whose position and normal are close enough lend their accumulated irradiance and their count of
frames s. With alpha = max(1 / (s + 1), 0.2) the result is alpha * current + (1 - alpha) * history: an exact
running mean over up to five frames, exponential with 0.2 afterwards.

Sources: Koskela et al. 2019, "Blockwise Multi-Order Feature Regression for Real-Time Path-Tracing
Reconstruction", doi:10.1145/3269978; Fan et al. 2021, "Real-time Monte Carlo Denoising with Weight Sharing
Kernel Prediction Network", doi:10.1111/cgf.14338. Unlike both, points behind the preceding camera
(w <= 0) are rejected and pixels that hit nothing are not projected; like WSKP and unlike BMFR, the count is a
float without a cap.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data.camera import footprint, project
from data.derive import derive, no_hit
from data.frame import Frame, Image

BLEND = 0.2
"""Smallest weight of the current frame."""

POSITION_LIMIT_FOOTPRINTS = 6.0
"""Automatic position limit in median pixel footprints of the first blended frame, a sequence's second.

At 1280x720 and 60 degrees it is 0.5 % of the median depth: 0.05 units in a sponza seen at 9 units (BMFR:
0.04), 0.03 in a living room at 5 (BMFR: 0.03). On four sequences of 320x180 with jittered 1 spp the PSNR of
the accumulated radiance rises up to 5 footprints and stays within 0.3 dB of its maximum from there on."""

NORMAL_LIMIT_SQUARED = 1.0
"""Automatic limit of the squared difference of normals: 60 degrees, BMFR's value for its classroom."""


_BAND = 32
"""Rows that are gathered at a time, so that intermediate planes stay within the cache."""


@dataclass(frozen=True)
class Thresholds:
    """Limits within which a pixel of the preceding frame counts as the same surface.

    Attributes:
        position_limit_squared: Squared distance of world positions, in squared scene units.
        normal_limit_squared: Squared distance of unit normals, 0 to 4.
    """

    position_limit_squared: float
    normal_limit_squared: float


def automatic_thresholds(frame: Frame) -> Thresholds:
    """Return limits from the scene's scale: the median footprint of a pixel on the surfaces of a frame.

    Raises:
        ValueError: The frame has no position or camera.
    """
    frame.require("position")
    if frame.camera is None:
        raise ValueError(f"{frame.label}: no camera, so its scale is unknown; give the position limit")
    sizes = footprint(frame.camera, np.ascontiguousarray(frame.buffers["position"]))
    hits = sizes[~no_hit(frame)[..., 0] & (sizes > 0)]
    size = float(np.median(hits)) if hits.size else 1.0
    return Thresholds((POSITION_LIMIT_FOOTPRINTS * size) ** 2, NORMAL_LIMIT_SQUARED)


class Accumulator:
    """Accumulates irradiance over the frames of a sequence.

    The history starts anew when the scene or the size changes, when a frame does not follow its predecessor,
    or when the data set says that its frames are no sequence.
    """

    def __init__(
        self, position_limit_squared: float | None = None, normal_limit_squared: float | None = None
    ) -> None:
        """Choose the limits; what is None is chosen from the first frame of a sequence that is blended.

        That is its second frame, whose surfaces are looked up in the first; the limits hold until the
        sequence ends.

        Raises:
            ValueError: A limit is not positive.
        """
        for name, value in (("position", position_limit_squared), ("normal", normal_limit_squared)):
            if value is not None and not value > 0:
                raise ValueError(f"{name}_limit_squared is {value}, expected a positive number")
        self._given = (position_limit_squared, normal_limit_squared)
        self._limits: Thresholds | None = None
        self._previous: Frame | None = None

    def reset(self) -> None:
        """Forget the history."""
        self._previous = self._limits = None

    def step(self, frame: Frame) -> Frame:
        """Accumulate one frame.

        Args:
            frame: With `irradiance`, or `color` and an albedo. Reprojects with `position` and the camera of
                the preceding frame; where one of them is absent, and at pixels that hit nothing, with
                `motion`. A test whose buffer is absent is left out.

        Returns:
            The frame with accumulated `irradiance` and the count `history`, marked as accumulated. `color`
            stays that of this frame alone. `notes["accumulation"]` says how it was done.

        Raises:
            ValueError: The frame is accumulated already, or can neither be reprojected nor start a sequence.
        """
        if frame.accumulated:
            raise ValueError(f"{frame.label}: its irradiance is accumulated already")
        frame = derive(frame, ["irradiance"])
        if not self._follows(frame):
            self.reset()
        irradiance = frame.buffers["irradiance"]
        history = np.ones((frame.height, frame.width, 1), np.float32)
        how = "first frame"
        if self._previous is not None:
            irradiance, history, how = self._blend(frame, self._previous)
        result = replace(frame.with_buffers(irradiance=irradiance, history=history), accumulated=True)
        result.notes["accumulation"] = how
        self._previous = result
        return result

    def _follows(self, frame: Frame) -> bool:
        last = self._previous
        return (
            last is not None
            and frame.follows(last)
            and (last.height, last.width) == (frame.height, frame.width)
            and frame.notes.get("sequence") is not False
        )

    def _blend(self, frame: Frame, last: Frame) -> tuple[Image, Image, str]:
        target, how = previous_pixels(frame, last)
        colors, counts, kept = _gather(frame, last, target, self._thresholds(frame))
        irradiance, history = blend(frame.buffers["irradiance"], colors, counts, kept)
        return irradiance, history, how

    def _thresholds(self, frame: Frame) -> Thresholds:
        if self._limits is None:
            position, normal = self._given
            if position is None:
                measurable = "position" in frame.buffers and frame.camera is not None
                position = automatic_thresholds(frame).position_limit_squared if measurable else np.inf
            self._limits = Thresholds(position, NORMAL_LIMIT_SQUARED if normal is None else normal)
        return self._limits


def accumulate(
    frames: Iterable[Frame],
    position_limit_squared: float | None = None,
    normal_limit_squared: float | None = None,
) -> Iterator[Frame]:
    """Accumulate the frames of one or several sequences, in order; see `Accumulator`."""
    accumulator = Accumulator(position_limit_squared, normal_limit_squared)
    for frame in frames:
        yield accumulator.step(frame)


def blend(
    current: Image, history: Image, counts: NDArray[np.float32], kept: NDArray[np.bool_]
) -> tuple[Image, Image]:
    """Return blended irradiance (H, W, 3) and new counts (H, W, 1).

    Args:
        current: Irradiance of this frame (H, W, 3).
        history: Reprojected accumulated irradiance (H, W, 3).
        counts: Reprojected number of frames (H, W).
        kept: Where any neighbour was accepted (H, W); elsewhere the pixel starts anew.
    """
    alpha = np.where(kept, np.maximum(1 / (counts + 1), np.float32(BLEND)), np.float32(1))
    result = alpha[..., None] * current + (1 - alpha[..., None]) * history
    number = np.where(alpha < 1, counts + 1, np.float32(1))
    return result.astype(np.float32), number[..., None].astype(np.float32)


def previous_pixels(frame: Frame, last: Frame) -> tuple[NDArray[np.float32], str]:
    """Return where each pixel's surface was, as indices x and y (2, H, W); NaN where nowhere."""
    moved = np.full((2, frame.height, frame.width), np.nan, np.float32)
    if "motion" in frame.buffers:
        moved[1], moved[0] = np.mgrid[0 : frame.height, 0 : frame.width]
        moved += frame.buffers["motion"].transpose(2, 0, 1)
    if "position" in frame.buffers and "position" in last.buffers and last.camera is not None:
        pixels, w = project(last.camera, np.ascontiguousarray(frame.buffers["position"]))
        offset = (0.5, 0.5) if frame.camera is None else frame.camera.offset
        found = np.empty_like(moved)
        with np.errstate(over="ignore", invalid="ignore"):  # of points behind the camera
            for axis in range(2):
                np.subtract(pixels[..., axis], offset[axis], out=found[axis], casting="same_kind")
        np.copyto(found, np.float32(np.nan), where=w <= 0)
        np.copyto(found, moved, where=no_hit(frame)[..., 0])
        return found, "position and the preceding camera"
    if "motion" in frame.buffers:
        return moved, "motion"
    raise ValueError(
        f"{frame.label}: accumulation needs `position` and cameras, or `motion`; "
        f"the frame has {', '.join(frame.buffers)}{'' if frame.camera else ' and no camera'}"
    )


def _gather(
    frame: Frame, last: Frame, target: NDArray[np.float32], limits: Thresholds
) -> tuple[Image, NDArray[np.float32], NDArray[np.bool_]]:
    """Return bilinear history colour and count over the accepted neighbours, and where there is any."""
    tests = {
        name: limit
        for name, limit in (
            ("position", limits.position_limit_squared),
            ("normal", limits.normal_limit_squared),
        )
        if name in frame.buffers and name in last.buffers and np.isfinite(limit)
    }
    planes = _planes([last.buffers[n] for n in ("irradiance", "history", *tests)])
    current = _planes([frame.buffers[n] for n in tests])
    sums = np.empty((5, frame.height, frame.width), np.float32)
    for top in range(0, frame.height, _BAND):
        rows = slice(top, top + _BAND)
        sums[:, rows] = _gather_band(planes, target[:, rows], current[:, rows], list(tests.values()))
    kept = sums[4] > 0
    mean = np.asarray(sums[:4] / np.where(kept, sums[4], np.float32(1)), np.float32)
    return mean[:3].transpose(1, 2, 0), mean[3], kept


def _planes(images: list[Image]) -> NDArray[np.float32]:
    """Return all channels as contiguous planes (C, H, W), on which numpy is several times faster."""
    if not images:
        return np.empty((0, 1, 1), np.float32)
    planes = np.empty((sum(image.shape[2] for image in images), *images[0].shape[:2]), np.float32)
    channels = (image[..., c] for image in images for c in range(image.shape[2]))
    for plane, channel in zip(planes, channels, strict=True):
        plane[...] = channel
    return planes


def _gather_band(
    planes: NDArray[np.float32],
    target: NDArray[np.float32],
    current: NDArray[np.float32],
    limits: list[float],
) -> NDArray[np.float32]:
    """Return weighted sums of colour and count, and the sum of weights (5, rows, W).

    Args:
        planes: Preceding irradiance, history and tested buffers (4 + 3 * tests, H, W).
        target: Where to look (2, rows, W), x and y, NaN for nowhere.
        current: Tested buffers of this band (3 * tests, rows, W).
        limits: Squared limit of each test.
    """
    _, height, width = planes.shape
    flat = planes.reshape(len(planes), -1)
    with np.errstate(invalid="ignore"):
        corner = np.floor(target)
        near = (corner[0] >= -1) & (corner[0] < width) & (corner[1] >= -1) & (corner[1] < height)
    corner = np.where(near, corner, np.float32(-2))
    fraction = np.where(near, target - corner, np.float32(0))
    x0, y0 = corner.astype(np.intp)
    across = [_neighbour(x0 + d, fraction[0] if d else 1 - fraction[0], width) for d in (0, 1)]
    down = [_neighbour(y0 + d, fraction[1] if d else 1 - fraction[1], height) for d in (0, 1)]
    sums = np.zeros((5, *near.shape), np.float32)
    for row, inside_y, share_y in down:
        row *= width
        for column, inside_x, share_x in across:
            source = row + column
            accepted = inside_x & inside_y
            for i, limit in enumerate(limits):
                squares = np.zeros(near.shape, np.float32)
                for c in range(3):
                    difference = flat[4 + 3 * i + c].take(source)
                    np.subtract(current[3 * i + c], difference, out=difference)
                    difference *= difference
                    squares += difference
                accepted &= squares < limit
            weight = share_x * share_y
            weight *= accepted
            for c in range(4):
                value = flat[c].take(source)
                value *= weight
                sums[c] += value
            sums[4] += weight
    return sums


def _neighbour(
    index: NDArray[np.intp], share: NDArray[np.float32], number: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.float32]]:
    """Return a row or column of the four neighbours within the image, where it was within, and its weight."""
    return index.clip(0, number - 1), (index >= 0) & (index < number), share
