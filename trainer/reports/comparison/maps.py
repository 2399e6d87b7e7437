"""FLIP maps of the page: computed here from the files, and kept as small integers."""

from __future__ import annotations

import numpy as np
import torch

from trainer.metrics.flip import flip_ldr_map
from trainer.reports.comparison.levels import Array, Integers

FLIP_LEVELS = 64
"""FLIP maps are stored in steps of 1/64."""


def flip_map(radiance: Array, target: Array, exposure: float) -> Array:
    """Return LDR-FLIP (H, W) of radiance (H, W, 3) against its target, both at an exposure."""
    one, other = (
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)) * np.float32(exposure))[None]
        for image in (radiance, target)
    )
    with torch.inference_mode():
        found: Array = flip_ldr_map(one, other)[0].numpy()
    return found


def block_means(flip: Array, block: int) -> Integers:
    """Return the means of blocks in steps of 1 / `FLIP_LEVELS`; those at the border repeat its pixels."""
    height, width = flip.shape
    padded = np.pad(flip, ((0, -height % block), (0, -width % block)), mode="edge")
    means = padded.reshape(-(-height // block), block, -(-width // block), block).mean((1, 3))
    return np.rint(means * FLIP_LEVELS).astype(np.int32)
