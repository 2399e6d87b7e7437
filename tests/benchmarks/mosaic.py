"""A real frame of any size: the sample's stills side by side, each continued by its mirror image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from data.derive import derive
from data.exr import read_frame
from data.sample import SAMPLES

STILLS = (
    "indoor-000002",
    "outdoor-000001",
    "indoor-000004",
    "outdoor-000003",
    "indoor-000006",
    "outdoor-000005",
)


def mosaic(height: int, width: int, names: Sequence[str]) -> dict[str, Tensor]:
    """Return buffers (1, C, height, width).

    A still of 160x160 and its mirror images make a seamless square of 320x320; the squares of the stills
    follow each other row by row, so that a larger frame has more of the same, not larger objects.

    Args:
        height: Rows.
        width: Columns.
        names: Buffers, such as `color_a`.
    """
    squares = [_square(still, names) for still in STILLS]
    side = squares[0][names[0]].shape[-1]
    down, across = -(-height // side), -(-width // side)
    result = {}
    for name in names:
        tiles = [squares[n % len(squares)][name] for n in range(down * across)]
        rows = [torch.cat(tiles[across * i : across * (i + 1)], -1) for i in range(down)]
        result[name] = torch.cat(rows, -2)[..., :height, :width].contiguous()
    return result


def _square(still: str, names: Sequence[str]) -> dict[str, Tensor]:
    """Return the buffers of a still with its mirror images, (1, C, 2 H, 2 W)."""
    frame = derive(read_frame(SAMPLES["stills"] / still / "f000.exr"), names)
    result = {}
    for name in names:
        image = torch.from_numpy(np.ascontiguousarray(frame.buffers[name].transpose(2, 0, 1)))[None]
        image = torch.cat([image, image.flip(-1)], -1)
        result[name] = torch.cat([image, image.flip(-2)], -2)
    return result
