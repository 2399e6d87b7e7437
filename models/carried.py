"""States of recurrent methods, cut into tiles and put together again.

The maps of a state have the image's size or a fraction of it: one of their pixels is a square of pixels of
the image, and tiles begin and end at multiples of its side, since `Denoiser.multiple` is one. What a single
tile of the whole image makes is carried as it is, whatever its shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from models.denoiser import State

Part = tuple[slice, slice]
"""Rows and columns of an image."""


def continued(call: Any, state: State, read: Part, size: tuple[int, int]) -> Callable[..., Any]:
    """Return the call of a method on a tile that is given what it reads of the state of the whole image.

    Args:
        call: The method, called with buffers and state.
        state: Of the whole image.
        read: The tile.
        size: Rows and columns of the image.
    """
    part = state
    if not _everything(read, size):
        part = {name: maps[(..., *_shrunk(read, maps, size))].contiguous() for name, maps in state.items()}

    def step(buffers: Mapping[str, Tensor]) -> Any:
        return call(buffers, part)

    return step


class Carried:
    """The state of a whole image, put together from the cores of its tiles.

    Args:
        size: Rows and columns of the image.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.state: State | None = None

    def place(self, core: Part, read: Part, made: State | None) -> None:
        """Copy the core of the state of a tile.

        Args:
            core: Of the tile, in the image.
            read: What the tile read, in the image.
            made: Its state; None: the method has none.
        """
        if made is None or _everything(core, self.size):
            self.state = made
            return
        tile = (read[0].stop - read[0].start, read[1].stop - read[1].start)
        inner = tuple(slice(c.start - r.start, c.stop - r.start) for c, r in zip(core, read, strict=True))
        self.state = {} if self.state is None else self.state
        for name, maps in made.items():
            rows, columns = _shrunk((inner[0], inner[1]), maps, tile)
            if name not in self.state:
                sides = [w * m // t for w, m, t in zip(self.size, maps.shape[-2:], tile, strict=True)]
                self.state[name] = maps.new_empty(*maps.shape[:-2], *sides)
            whole = self.state[name]
            whole[(..., *_shrunk(core, whole, self.size))] = maps[..., rows, columns]


def _everything(part: Part, size: tuple[int, int]) -> bool:
    return all((p.start, p.stop) == (0, side) for p, side in zip(part, size, strict=True))


def _shrunk(part: Part, maps: Tensor, size: tuple[int, int]) -> Part:
    """Return where a part of an image lies in maps of its size or a fraction of it."""
    steps = (size[0] // maps.shape[-2], size[1] // maps.shape[-1])
    rows, columns = (slice(p.start // step, p.stop // step) for p, step in zip(part, steps, strict=True))
    return rows, columns
