"""Where one pixel looks: the attention of a network for a query pixel of a frame of any size.

Only a crop around the query is computed: the network's own block with the halo that it declares, cut where a
tile of the frame would be cut, so that the maps equal those of the whole frame to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.tiling import Tileable, aligned_halo, numbers_of_frame
from trainer.export.artifact import Artifact
from trainer.loading import Model


@runtime_checkable
class Attentive(Tileable, Protocol):
    """A denoiser whose attention can be looked at."""

    def attention(self, buffers: Mapping[str, Tensor], row: int, column: int) -> Tensor:
        """Return the weights (blocks, heads, H, W) with which a pixel reads all others, 0 where it does not.

        Those of one block and head add up to 1, less what went to places outside of the image.
        """


@dataclass(frozen=True)
class Attention:
    """The attention of one pixel.

    Attributes:
        query: Column and row of the pixel.
        corner: Column and row of the first pixel of `maps`.
        maps: Weights (blocks, heads, h, w) of the pixels that it reads; others got none.
    """

    query: tuple[int, int]
    corner: tuple[int, int]
    maps: NDArray[np.float32]


def attentive(model: Model, name: str) -> Attentive:
    """Return the model if its attention can be looked at.

    Args:
        model: Any model.
        name: What the user called it.

    Raises:
        ValueError: It is an exported file, or a method without attention.
    """
    needed = "--attention needs a checkpoint of a network with attention, such as AFGSA"
    if isinstance(model, Artifact):
        raise ValueError(
            f"{needed}; {name} is an exported file, which holds the image only: give the checkpoint it was "
            "made from"
        )
    if not isinstance(model, Attentive):
        raise ValueError(f"{needed}; {name} holds {type(model).__name__}, which has none")
    return model


def inside(query: tuple[int, int], width: int, height: int) -> None:
    """Check that a query lies in the image.

    Raises:
        ValueError: It does not; the message says what is allowed.
    """
    if not (0 <= query[0] < width and 0 <= query[1] < height):
        raise ValueError(
            f"--attention {query[0]},{query[1]} lies outside of the image of {width}x{height} pixels: "
            f"expected X from 0 to {width - 1} and Y from 0 to {height - 1}"
        )


def attention_of(model: Attentive, buffers: Mapping[str, Tensor], query: tuple[int, int]) -> Attention:
    """Return the attention of one pixel of a frame.

    Args:
        model: Whose.
        buffers: Its inputs (1, C, H, W) of the whole frame, optionally frame numbers.
        query: Column and row of the pixel.
    """
    height, width = buffers[model.inputs[0]].shape[-2:]
    inside(query, width, height)
    columns, rows = _around(query[0], width, model), _around(query[1], height, model)
    numbers = numbers_of_frame(model, buffers)
    crop = {name: buffers[name][..., rows, columns].contiguous() for name in model.inputs}
    with torch.inference_mode():
        maps = model.attention({**crop, **numbers}, query[1] - rows.start, query[0] - columns.start)
    seen = (maps > 0).flatten(0, 1).any(0)
    # The query belongs to the window even where its own weight has underflown.
    seen[query[1] - rows.start, query[0] - columns.start] = True
    tall, wide = _extent(seen.any(1)), _extent(seen.any(0))
    corner = (columns.start + wide.start, rows.start + tall.start)
    return Attention(query, corner, np.ascontiguousarray(maps[..., tall, wide].float().cpu().numpy()))


def _around(position: int, size: int, model: Attentive) -> slice:
    """Return the block of a pixel with its halo, on the model's own grid, cut where the image ends."""
    multiple, halo = model.multiple, aligned_halo(model)
    start = position // multiple * multiple
    return slice(max(0, start - halo), min(size, start + multiple + halo))


def _extent(used: Tensor) -> slice:
    indices = torch.nonzero(used).flatten()
    return slice(int(indices[0]), int(indices[-1]) + 1)
