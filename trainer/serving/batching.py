"""The thread that runs the model: tiles of several requests that have the same shape are one batch.

Requests hand over one tile at a time and wait for it, so that none of them keeps the others out. A batch is
what waits when the model becomes free; nothing is held back to fill it. An element of a batch never
influences another (every denoiser is tested for it), so a result is that of the request alone up to rounding.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from data.buffers import SAMPLES
from models.denoiser import Denoised
from models.pace import listening
from models.tiling import BYTES_PER_PIXEL, Call
from trainer.serving.limits import Over, Ticket

CPU_PIXELS = 1 << 16
"""Pixels of a batch beyond which a CPU gains nothing. With WSKP on two cores a tile in a batch of four took
0.45 of the time of a single one at 32x32, 0.74 at 64x64, 0.88 at 128x128, 1.0 at 256x256, 1.3 at 512x512."""

_LOOK = 5.0
"""Seconds after which who waits for a tile looks whether the model's thread is still there."""

_LOG = logging.getLogger("penumbra.serve")

Told = Callable[[int, float], None]
"""Told the tiles of a batch and their megapixels."""


class Failed(Exception):  # noqa: N818  # a state, which the log explains
    """The model's thread has ended though nobody asked it to: the service has to be started again."""


@dataclass(frozen=True)
class Batching:
    """How tiles are joined.

    Attributes:
        most: Tiles of a batch.
        memory: Bytes that the model may take for a batch of more than one tile.
        pixels: Of a batch of more than one tile; None: only the memory limits it.
        threads: Of PyTorch; None: its own choice.
    """

    most: int = 4
    memory: int = 2 * 1024**3
    pixels: int | None = None
    threads: int | None = None


@dataclass(frozen=True, eq=False)  # the same tile is the same object: tensors have no truth value
class _Tile:
    call: Call
    buffers: Mapping[str, Tensor]
    ticket: Ticket
    result: Future[Any] = field(default_factory=Future)

    def key(self) -> tuple[Any, ...]:
        """Return what tiles must have in common to be one batch: the method, and names and shapes."""
        shapes = ((name, value.shape[1:], value.dtype) for name, value in self.buffers.items())
        return (self.call, *sorted(shapes, key=lambda entry: entry[0]))

    def pixels(self) -> int:
        """Return the pixels of its images."""
        first = next(value for value in self.buffers.values() if value.ndim > 3)
        return first.shape[0] * first.shape[-2:].numel()

    def bytes(self) -> int:
        """Return the working memory that the method declares for this tile."""
        method = getattr(self.call, "__self__", self.call)
        first = next(value for value in self.buffers.values() if value.ndim > 3)
        frames = first.shape[1] if getattr(method, "frames", 0) else 1
        samples = self.buffers[SAMPLES].shape[1:3].numel() if SAMPLES in self.buffers else 0
        per_pixel = int(getattr(method, "bytes_per_pixel", BYTES_PER_PIXEL)) + 4 * samples
        return per_pixel * frames * self.pixels()


class Batcher:
    """Runs a model for several requests.

    Args:
        batching: How tiles are joined.
        told: Called after each batch.
    """

    def __init__(self, batching: Batching, told: Told = lambda tiles, megapixels: None) -> None:
        self.batching, self.told = batching, told
        self._waiting: deque[_Tile] = deque()
        self._changed = threading.Condition()
        self._closed = self._asked = False
        self._thread = threading.Thread(target=self._work, name="model", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the model's thread runs."""
        return self._thread.is_alive()

    def run(self, ticket: Ticket, call: Call, buffers: Mapping[str, Tensor]) -> Any:
        """Return `call(buffers)`, computed in the model's thread, perhaps beside tiles of other requests.

        Raises:
            Over: Nobody waits for the result any more.
            Failed: The model's thread has ended.
            Exception: What the method raised.
        """
        tile = _Tile(call, buffers, ticket)
        with self._changed:
            if self._closed:
                raise self._ended()
            self._waiting.append(tile)
            self._changed.notify()
        while not wait([tile.result], _LOOK).done:
            if not self.alive:
                raise self._ended()
        return tile.result.result()

    def close(self) -> None:
        """End the thread after the batch that it works on; who waits gets `Over`."""
        with self._changed:
            self._asked = self._closed = True
            self._changed.notify()
        self._thread.join()

    def _ended(self) -> Exception:
        return Over() if self._asked else Failed()

    def _work(self) -> None:
        tiles: list[_Tile] = []
        try:
            if self.batching.threads is not None:
                torch.set_num_threads(self.batching.threads)
            while tiles := self._next():
                self._run(tiles)
        except Exception:
            _LOG.exception("the thread that runs the model has ended")
        finally:
            with self._changed:
                self._closed = True
                for tile in [*tiles, *self._waiting]:
                    if not tile.result.done():
                        tile.result.set_exception(self._ended())

    def _next(self) -> list[_Tile]:
        """Wait for tiles and return those of the next batch; none when it is time to end."""
        with self._changed:
            while True:
                self._drop()
                if self._closed:
                    return []
                if self._waiting:
                    return self._taken()
                self._changed.wait()

    def _drop(self) -> None:
        """Leave out tiles that nobody waits for any more."""
        for tile in [tile for tile in self._waiting if tile.ticket.over]:
            self._waiting.remove(tile)
            tile.result.set_exception(Over())

    def _taken(self) -> list[_Tile]:
        """Take the oldest tile, and those like it as far as the memory reaches."""
        first = self._waiting[0]
        room = min(self.batching.most, self.batching.memory // max(first.bytes(), 1))
        if self.batching.pixels is not None:
            room = min(room, self.batching.pixels // first.pixels())
        key = first.key()
        like = [tile for tile in list(self._waiting)[1:] if tile.key() == key]
        taken = [first, *like[: max(room - 1, 0)]]
        for tile in taken:
            self._waiting.remove(tile)
        return taken

    def _run(self, tiles: list[_Tile]) -> None:
        try:
            results = _together(tiles)
        except Exception as error:
            if len(tiles) > 1 and not isinstance(error, Over):
                # What fails for one must not fail for the others.
                for tile in tiles:
                    self._run([tile])
                return
            for tile in tiles:
                tile.result.set_exception(error)
            return
        self.told(len(tiles), sum(tile.pixels() for tile in tiles) / 1e6)
        for tile, result in zip(tiles, results, strict=True):
            tile.result.set_result(result)


def _together(tiles: list[_Tile]) -> list[Denoised]:
    """Call the method once for all tiles; stops at its next step when nobody waits for any of them."""

    def look(share: float) -> None:
        if all(tile.ticket.over for tile in tiles):
            raise Over

    call = tiles[0].call
    with torch.inference_mode(), listening(look):
        if len(tiles) == 1:
            return [call(tiles[0].buffers)]
        names = tiles[0].buffers
        joined = {name: torch.cat([tile.buffers[name] for tile in tiles]) for name in names}
        result = call(joined)
    counts = [next(iter(tile.buffers.values())).shape[0] for tile in tiles]
    color, state, aux = (_divided(maps, counts) for maps in ({"": result.color}, result.state, result.aux))
    return [Denoised(c[""], s, a) for c, s, a in zip(color, state, aux, strict=True)]


def _divided(maps: Mapping[str, Tensor] | None, counts: list[int]) -> list[Any]:
    """Return the maps of each tile of a batch, by name; None for each where there are none."""
    if not maps:
        return [None] * len(counts)
    parts = {name: whole.split(counts) for name, whole in maps.items()}
    return [{name: part[tile] for name, part in parts.items()} for tile in range(len(counts))]
