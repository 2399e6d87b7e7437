"""Short sequences of a small scene whose geometry and motion are known, for tests of sequence filters.

A board stands in front of a wall whose depth grows downwards; above is sky. The camera moves to the right, so
that the board moves farther than the wall, uncovers it, and both leave the image.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.classical.sequence_filter import SequenceFilter
from models.denoiser import Denoised

Array = NDArray[np.float64]
Buffers = dict[str, Tensor]

FOCAL = 10.0
SKY_ROWS = 2
BOARD = 4.0
"""Where the middle of the board is."""


def frame(camera: float, before: float, height: int, width: int, seed: int) -> dict[str, Array]:
    """Return buffers (H, W, C) of the view from x = `camera`; the frame before was seen from x = `before`."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[:height, :width].astype(float)
    across, down = column - width / 2, row - height / 2
    wall = 8 + 0.2 * row
    board = 4 + 0.05 * row
    on_board = (np.abs(across * board / FOCAL + camera - BOARD) < 1.3) & (np.abs(down) < height / 4)
    depth = np.where(on_board, board, wall)
    x, y = across * depth / FOCAL + camera, down * depth / FOCAL
    turn = np.where(on_board, 0.9, 0.02 * np.sin(x))
    normal = np.stack([np.sin(turn), 0 * turn, -np.cos(turn)], -1)
    motion = np.stack([(camera - before) * FOCAL / depth, 0 * depth], -1)
    albedo = np.stack([0.5 + 0.3 * np.sin(3 * x), 0.4 + 0 * x, np.where(on_board, 0.2, 0.8)], -1)
    light = np.stack([1 + 0.5 * np.sin(x), 1 + 0.2 * y, np.where(on_board, 2.0, 0.5)], -1).clip(0.1)
    found = {
        "irradiance": light
        * random.exponential(size=(height, width, 1))
        * random.uniform(0.8, 1.2, light.shape),
        "albedo": albedo,
        "normal": normal,
        "depth": depth[..., None],
        "position": np.stack([x, y, depth], -1),
        "motion": motion,
    }
    for name in ("normal", "depth", "position", "motion"):
        found[name][:SKY_ROWS] = 0
    return found


def walk(count: int, height: int = 10, width: int = 12, step: float = 1.6) -> list[dict[str, Array]]:
    """Return the frames of a camera that moves `step` per frame."""
    return [frame(i * step, (i - 1) * step, height, width, i) for i in range(count)]


def sequence(
    count: int = 3, height: int = 16, width: int = 18, kind: torch.dtype = torch.float64
) -> list[Buffers]:
    """Return the frames of `walk` as batches of one."""
    return [tensors(buffers, kind) for buffers in walk(count, height, width)]


def at_rest(count: int, height: int = 16, width: int = 18) -> list[Buffers]:
    """Return frames of a camera that stands still: only the noise differs."""
    first, *others = sequence(count, height, width)
    held = {**first, "motion": torch.zeros_like(first["motion"])}
    return [held, *({**held, "irradiance": other["irradiance"]} for other in others)]


def run(network: SequenceFilter, frames: list[Buffers]) -> list[Denoised]:
    """Denoise frames one after the other, each with the state of the one before."""
    results: list[Denoised] = []
    for buffers in frames:
        results.append(network(buffers, results[-1].state if results else None))
    return results


def tensors(buffers: dict[str, Array], dtype: torch.dtype = torch.float64) -> Buffers:
    """Return buffers as a batch of one, (1, C, H, W)."""
    return {name: torch.from_numpy(image).permute(2, 0, 1)[None].to(dtype) for name, image in buffers.items()}


def image(tensor: Tensor) -> Array:
    """Return a batch of one as (H, W, C)."""
    array: Array = tensor[0].permute(1, 2, 0).double().numpy()
    return array


def joined(*batches: Buffers) -> Buffers:
    """Return several batches as one."""
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}


def damages() -> dict[str, Callable[[Buffers], Buffers]]:
    """Return what makes frames of renderers that failed: name → function of a batch."""

    def light(change: Callable[[Tensor], Tensor]) -> Callable[[Buffers], Buffers]:
        return lambda batch: {**batch, "irradiance": change(batch["irradiance"])}

    def everything(value: float) -> Callable[[Buffers], Buffers]:
        return lambda batch: {name: torch.full_like(plane, value) for name, plane in batch.items()}

    return {
        "some not a number": light(lambda x: torch.where(x > 1, torch.nan, x)),
        "infinite": light(lambda x: torch.full_like(x, torch.inf)),
        "fireflies": light(lambda x: torch.where(x > 2, 65504.0, x)),
        "largest": light(lambda x: torch.full_like(x, 3e38)),
        "negative": light(lambda x: -x),
        "black, nothing hit": everything(0.0),
        "all not a number": everything(torch.nan),
        "all infinite": everything(torch.inf),
        "all largest": everything(3e38),
    }
