"""Space-time methods on clips: frames are denoised in chunks, with as much context as exactness needs.

A frame's result depends on `frame_halo` frames on each side. A chunk of n frames is denoised with those
around it, so that every frame is worked on (n + 2 halo) / n times: the memory budget decides how long chunks
are, and how large the spatial tiles are that a chunk is cut into. Results do not depend on either.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from data.buffers import buffer
from data.frame import Frame
from models.tiling import Tileable, core_size, denoise_in_tiles, times_read
from trainer.clips import Clip, Item
from trainer.denoising import ClipDenoiser, Prepared, Result, Settings
from trainer.loading import Loaded, Model
from trainer.progress import Heard

COSTLY = 3.0
"""How often a frame may be computed before it is said that more memory would help."""


@dataclass(frozen=True)
class Chunks:
    """How a clip is cut.

    Attributes:
        length: Frames of a chunk.
        halo: Frames of context on each side.
        cost: How often a pixel of a frame is computed, by chunks and tiles together.
    """

    length: int
    halo: int
    cost: float


def plan(model: Model, size: tuple[int, int], count: int, budget: int) -> Chunks:
    """Return the chunks that cost the least work.

    Half of the budget may be taken by the frames that are held, the rest by the model; at least the frames of
    a chunk of one with its context are held, whatever that takes.

    Args:
        model: With `frames`.
        size: Rows and columns of a frame.
        count: Frames of the clip.
        budget: Memory in bytes.

    Raises:
        ValueError: Not even the smallest tile of one frame with its context fits into the budget.
    """
    halo = max(model.frame_halo, model.frames)
    held = 4 * sum(buffer(name).channels for name in model.inputs) * size[0] * size[1]
    most = max(1, min(count, budget // (2 * held) - 2 * halo))
    if 2 * count * held <= budget:
        most = count
    best: Chunks | None = None
    for pieces in sorted({-(-count // length) for length in range(1, most + 1)}):
        length = -(-count // pieces)
        frames = min(count, length + 2 * halo)
        try:
            cost = _spatial(model, size, budget - frames * held, frames) * frames / length
        except ValueError:
            continue
        if best is None or cost < best.cost:
            best = Chunks(length, halo, cost)
    if best is None:
        frames = min(count, 1 + 2 * halo)
        return Chunks(1, halo, _spatial(model, size, budget, frames) * frames)
    return best


def _spatial(model: Tileable, size: tuple[int, int], budget: int, frames: int) -> float:
    tall, wide = (-(-side // model.multiple) * model.multiple for side in size)
    return times_read(model, (tall, wide), core_size(model, (tall, wide), budget, frames))


def denoiser_of(loaded: Loaded, clip: Clip, settings: Settings, progress: Heard) -> ClipDenoiser:
    """Return what denoises the frames of a clip; raises as `ClipDenoiser`."""
    cls = SequenceDenoiser if loaded.model.frames else ClipDenoiser
    return cls(loaded, clip, settings, progress.say, progress.within)


class SequenceDenoiser(ClipDenoiser):
    """Denoises the frames of a clip with a space-time method; results come some frames later.

    Runs of consecutive frames are one sequence each; arguments and errors as `ClipDenoiser`.
    """

    _run: _Run | None = None
    _left: int | None = None

    def push(self, item: Item, frame: Frame) -> Iterator[tuple[Item, Result]]:
        """Take the next frame and return what is finished with it; raises as `ClipDenoiser.step`."""
        if self._left is None:
            self._left = len(self.clip.items)
            self._remark()
        prepared = self.prepare(frame)
        if self._run is not None and not self._run.continued_by(prepared):
            if self.clip.sequence:
                self.say(f"{item.label} does not continue the frames before it: a new sequence starts")
            yield from self.finish()
        if self._run is None:
            size = (prepared.frame.height, prepared.frame.width)
            count = self._left if self.clip.sequence else 1
            chunks = plan(prepared.model, size, count, self.settings.memory)
            self._run = _Run(prepared, chunks, count)
            if chunks.cost > COSTLY:
                self.say(
                    f"chunks of {chunks.length} frame{'s' * (chunks.length != 1)} with {chunks.halo} more on "
                    f"each side: every frame is computed about {chunks.cost:.0f} times; a larger --memory "
                    "makes it fewer"
                )
        self._left -= 1
        self._run.add(item, prepared, self.tensors(prepared))
        if self._run.full:
            yield from self._chunk(self._run)

    def finish(self) -> Iterator[tuple[Item, Result]]:
        """Return what is left of the sequence."""
        run, self._run = self._run, None
        if run is not None:
            run.ended = True
            while run.waiting:
                yield from self._chunk(run)

    def _remark(self) -> None:
        name, count = self.loaded.source.reference, len(self.clip.items)
        if not self.clip.sequence:
            self.say(f"the frames are independent views: {name} denoises each alone, as a sequence of one")
        elif count == 1:
            self.say(f"a single frame: {name} denoises it as a sequence of one")

    def _chunk(self, run: _Run) -> Iterator[tuple[Item, Result]]:
        first, waiting = run.core()
        done = 0.0

        def advance(share: float) -> None:
            nonlocal done
            self.progress((share - done) * len(waiting))
            done = share

        buffers = {name: value.to(self.settings.device) for name, value in run.buffers().items()}
        with torch.inference_mode():
            denoised = denoise_in_tiles(
                run.model,
                buffers,
                tile=self.settings.tile,
                budget=self._budget(run),
                progress=advance,
                pace=self.pace(run.model, buffers),
                run=self.settings.run,
            )
        for t, (item, prepared) in enumerate(waiting, first):
            aux = {name: layer[0, t] for name, layer in (denoised.aux or {}).items()}
            yield item, self.result(prepared, denoised.color[0, t], aux)
        run.drop()

    def _budget(self, run: _Run) -> int:
        """Return what is left for the model; all of it where the frames alone take most of it."""
        left = self.settings.memory - run.bytes
        return left if 2 * left >= self.settings.memory else self.settings.memory


class _Run:
    """The frames of a sequence that are held: those that wait for their result, and context.

    Args:
        first: The first frame.
        chunks: How the sequence is cut.
        count: At most how many frames will come.
    """

    def __init__(self, first: Prepared, chunks: Chunks, count: int) -> None:
        self.model, self.chunks, self.ended = first.model, chunks, False
        self.size = (first.frame.height, first.frame.width)
        self.capacity = min(count, chunks.length + 2 * chunks.halo)
        self.waiting: list[tuple[Item, Prepared]] = []
        self._before = 0
        self._held: dict[str, Tensor] = {}
        self._numbers: dict[str, Tensor] = {}

    @property
    def count(self) -> int:
        """Frames that are held."""
        return self._before + len(self.waiting)

    @property
    def full(self) -> bool:
        """Whether a chunk has the frames after it that it needs."""
        return len(self.waiting) >= self.chunks.length + self.chunks.halo

    @property
    def bytes(self) -> int:
        """Memory of the frames."""
        return sum(buffers.nbytes for buffers in self._held.values())

    def continued_by(self, prepared: Prepared) -> bool:
        """Return whether a frame belongs to the same sequence."""
        size = (prepared.frame.height, prepared.frame.width)
        return prepared.follows and size == self.size and prepared.model is self.model

    def add(self, item: Item, prepared: Prepared, tensors: dict[str, Tensor]) -> None:
        """Hold one more frame: (1, C, H, W) of each buffer; numbers of the first frame stand for all."""
        images = {name: tensors.pop(name) for name in self.model.inputs}
        if not self._held:
            self._numbers = tensors
            self._held = {
                name: image.new_empty(1, self.capacity, *image.shape[1:]) for name, image in images.items()
            }
        for name, image in images.items():
            self._held[name][:, self.count] = image
        shown = {n: b for n, b in prepared.frame.buffers.items() if n == "reference"}
        slim: dict[str, Any] = {"buffers": shown or {"color": prepared.noisy}, "samples": None}
        self.waiting.append((item, replace(prepared, frame=replace(prepared.frame, **slim))))

    def buffers(self) -> dict[str, Tensor]:
        """Return the sequences (1, T, C, H, W) that the next chunk is denoised from."""
        return {**{n: image[:, : self.count] for n, image in self._held.items()}, **self._numbers}

    def core(self) -> tuple[int, list[tuple[Item, Prepared]]]:
        """Return where in the held frames the next chunk starts, and its frames."""
        last = self.ended and len(self.waiting) <= self.chunks.length + self.chunks.halo
        return self._before, self.waiting[: None if last else self.chunks.length]

    def drop(self) -> None:
        """Forget the frames that no later chunk needs."""
        done = len(self.core()[1])
        before = min(self.chunks.halo, self._before + done)
        start, stop = self._before + done - before, self.count
        for held in self._held.values():
            held[:, : stop - start] = held[:, start:stop].clone()
        self._before, self.waiting = before, self.waiting[done:]
