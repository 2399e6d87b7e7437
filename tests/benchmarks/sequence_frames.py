"""Frames of a moving camera of any size: a sequence of the sample side by side with itself."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from data.derive import derive
from data.frames import FrameSet
from data.sample import SAMPLES

SCENE = "classroom"


def sequence(height: int, width: int, names: Sequence[str], count: int = 8) -> list[dict[str, Tensor]]:
    """Return buffers (1, C, height, width) of consecutive frames with one sample per pixel.

    The scene's frames repeat beside and below each other. What leaves one of them enters the next, where
    another surface is: it is given up there, as it is at the border of an image.

    Args:
        height: Rows.
        width: Columns.
        names: Buffers, such as `irradiance` and `motion`.
        count: Number of frames, up to eight.
    """
    frames = FrameSet(SAMPLES["bmfr"])
    stored = [name for name in names if name != "motion"]
    read = [frames.read(SCENE, record.index, stored) for record in frames.frames(SCENE)[: count + 1]]
    result = []
    for before, now in pairwise(read):
        buffers = derive(now, list(names), previous=before.camera).buffers
        result.append({name: _repeated(buffers[name], height, width) for name in names})
    return result


def _repeated(image: np.ndarray, height: int, width: int) -> Tensor:
    times = (-(-height // image.shape[0]), -(-width // image.shape[1]), 1)
    whole = np.tile(image.astype(np.float32), times)[:height, :width]
    return torch.from_numpy(np.ascontiguousarray(whole.transpose(2, 0, 1)))[None]
