"""Crops of images side by side, for looking at: one row per scene, every method in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from trainer.metrics.functional import gamma

SIDE = 96
ZOOM = 2

Crop = NDArray[np.float32]
"""Exposed radiance (SIDE, SIDE, 3)."""


class Tile(NamedTuple):
    """One cell: exposed radiance, title above, scores below."""

    crop: Crop
    title: str
    caption: str = ""


def window(reference: Tensor) -> tuple[slice, slice]:
    """Return rows and columns of the square where an exposed reference (1, 3, H, W) has most detail.

    Detail is the deviation of display values within 7x7 pixels, of which large ones count little more than
    ordinary ones: an edge between black and white is no more to look at than any other. Squares that are
    mostly white count less, since nothing is seen in them.
    """
    shown = gamma(reference).mean(1, keepdim=True)
    mean, square = (F.avg_pool2d(x, 7, 1, 3) for x in (shown, shown.square()))
    detail = F.avg_pool2d((square - mean.square()).clamp_min(0).sqrt().clamp_max(0.1), SIDE, 8)
    white = F.avg_pool2d((shown >= 1).float(), SIDE, 8)
    place = int((detail * (1 - white)).flatten().argmax())
    top, left = 8 * (place // detail.shape[-1]), 8 * (place % detail.shape[-1])
    return slice(top, top + SIDE), slice(left, left + SIDE)


def cropped(image: Tensor, where: tuple[slice, slice], exposure: float) -> Crop:
    """Return the exposed part of an image (1, 3, H, W)."""
    rows, columns = where
    return np.ascontiguousarray((image[0, :, rows, columns] * exposure).permute(1, 2, 0).numpy())


def page(rows: Sequence[Sequence[Tile]], title: str, path: Path) -> None:
    """Write rows of tiles as a picture."""
    from trainer.reports.pictures import Panel, grid, tone_map

    panels = []
    for row in rows:
        side = ZOOM * SIDE
        shown = [tone_map(tile.crop).resize((side, side), Image.Resampling.NEAREST) for tile in row]
        panels.append([Panel(p, tile.title, tile.caption) for p, tile in zip(shown, row, strict=True)])
    path.parent.mkdir(parents=True, exist_ok=True)
    grid(panels, title).save(path)
