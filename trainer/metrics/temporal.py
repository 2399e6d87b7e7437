"""Metrics of sequences: how much a picture changes between frames where the same surface is seen in both.

A pixel is followed by the world position that it shows, through the camera of the preceding frame, or by its
motion vector; where another surface is found there, or none, the pixel does not count. Both metrics are taken
on the display values of `gamma`.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from data.frame import Frame
from data.temporal import NORMAL_LIMIT_SQUARED, automatic_thresholds, previous_pixels
from trainer.metrics.functional import gamma

Places = NDArray[np.int32]
"""Row and column (2, H, W) in the preceding frame of what each pixel shows; -1 where it was not seen."""


def places_before(frame: Frame, last: Frame) -> Places:
    """Return where each pixel of a frame was in the preceding one, at the nearest pixel.

    Args:
        frame: With `position` and a camera, or `motion`.
        last: The preceding frame; its `position` and `normal` tell whether it showed the same surface: no
            farther away than the limits of accumulation (`data.temporal`). What a frame lacks is not tested.

    Raises:
        ValueError: The frame has neither of those.
    """
    target, _ = previous_pixels(frame, last)
    height, width = frame.height, frame.width
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(target).all(0)
        column, row = (np.rint(np.where(seen, axis, -1)).clip(-1, 1e9).astype(np.int64) for axis in target)
    seen &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
    there = (row.clip(0, height - 1), column.clip(0, width - 1))
    limits = {"normal": NORMAL_LIMIT_SQUARED}
    if "position" in frame.buffers and frame.camera is not None:
        limits["position"] = automatic_thresholds(frame).position_limit_squared
    for name, limit in limits.items():
        if name in frame.buffers and name in last.buffers:
            apart = frame.buffers[name] - last.buffers[name][there]
            seen &= np.square(apart).sum(-1) < limit
    return np.where(seen, np.stack([row, column]), -1).astype(np.int32)


def change_gamma(now: Tensor, before: Tensor, places: Places) -> float:
    """Mean squared difference of a picture from the preceding one, motion compensated (Lai et al. 2018).

    The warping error of "Learning Blind Video Temporal Consistency" (doi:10.1007/978-3-030-01267-0_11). That
    of the reference is not 0: light and reflections change; what exceeds it is flicker.

    Args:
        now: Exposed radiance (3, H, W).
        before: That of the preceding frame.
        places: From `places_before`.

    Returns:
        The mean over RGB and the pixels that were seen, NaN where none was.
    """
    return float(torch.square(_difference(gamma(now), gamma(before), places)).mean())


def flicker_gamma(
    now: Tensor, before: Tensor, reference: Tensor, reference_before: Tensor, places: Places
) -> float:
    """Mean absolute difference of the error from that of the preceding frame, motion compensated.

    An error that stays where it is does not flicker: 0. Arguments as `change_gamma`, with the references of
    both frames; the mean is over RGB and the pixels that were seen, NaN where none was.
    """
    error, error_before = gamma(now) - gamma(reference), gamma(before) - gamma(reference_before)
    return float(_difference(error, error_before, places).abs().mean())


def _difference(now: Tensor, before: Tensor, places: Places) -> Tensor:
    row, column = torch.from_numpy(places.astype(np.int64))
    seen = row >= 0
    return now[:, seen] - before[:, row[seen], column[seen]]
