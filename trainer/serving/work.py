"""What is done for one request: decode, denoise, write; the same as `trainer denoise --model MODEL FILE`."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from data.exr import write_frame
from data.frame import Frame
from trainer.clips import Clip, Item, in_order
from trainer.denoising import ClipDenoiser, Result, Settings
from trainer.inputs import replaced_pixels
from trainer.loading import Loaded
from trainer.sequences import SequenceDenoiser
from trainer.serving.batching import Batcher
from trainer.serving.limits import Budget, Limits, Refusal, Ticket
from trainer.serving.readers import Readers
from trainer.serving.room import Place

EXR, ZIP = "image/x-exr", "application/zip"
_HEADERS = 1 << 20
"""Bytes that a file has beside its pixels, at most."""


@dataclass(frozen=True)
class Wish:
    """What a request wants.

    Attributes:
        exposure: A factor, `auto`, or None: the frame's own, measured where it has none.
        layers: Layer of the file → the buffer that it is.
        single: The result in float32, also where half precision would do.
    """

    exposure: float | str | None = None
    layers: Mapping[str, str] = field(default_factory=dict)
    single: bool = False


@dataclass(frozen=True)
class Done:
    """A result.

    Attributes:
        path: The EXR or ZIP file.
        kind: Its media type.
        notes: Remarks, as `trainer denoise` prints them.
        exposure: That of the first frame.
        pixels: Of all frames.
    """

    path: Path
    kind: str
    notes: tuple[str, ...]
    exposure: float
    pixels: int


class Workshop:
    """Works on requests, each in a thread of the caller.

    Args:
        loaded: The model.
        settings: How to denoise; `run` is set here.
        limits: Of a request.
        batcher: Runs the model.
        readers: Decode files.
    """

    def __init__(
        self, loaded: Loaded, settings: Settings, limits: Limits, batcher: Batcher, readers: Readers
    ) -> None:
        self.loaded, self.settings, self.limits = loaded, settings, limits
        self.batcher, self.readers = batcher, readers
        self.budget = Budget(limits.frame_bytes)

    def work(self, place: Place, name: str, wish: Wish, ticket: Ticket) -> Done:
        """Denoise an uploaded file.

        Args:
            place: Of this request; results are written into the folder of the upload.
            name: Of the file there.
            wish: What is wanted.
            ticket: Until when.

        Raises:
            Refusal: Something is wrong with the file, or there is no room for what comes of it.
            Over: Nobody waits for the result any more.
        """
        folder = place.upload
        place.take(self.readers.room(folder, name, ticket))
        frames = self.readers.frames(folder, name, ticket)
        sizes = {Path(frame["name"]): int(frame["bytes"]) for frame in frames}
        notes: dict[str, None] = {}
        items = tuple(
            Item(partial(self._read, folder, path, wish, ticket, notes), path.name, path.stem)
            for path in in_order(sizes)
        )
        denoiser = self._denoiser(Clip(items), wish, ticket, notes)
        sink = _Sink(place, name if len(frames) == 1 and str(frames[0]["name"]) == name else None, wish)
        held = self._held(max(sizes.values()), len(items))
        with self.budget.hold(held, ticket), ExitStack() as stack:
            stack.callback(sink.close)
            for item in items:
                ticket.check()
                try:
                    results = list(denoiser.push(item, item.read()))
                    if item is items[-1]:
                        results += denoiser.finish()
                except ValueError as error:
                    text = str(error)
                    raise Refusal(422, text if item.label in text else f"{item.label}: {text}") from error
                for done, result in results:
                    sink.add(done, result)
        return sink.done(tuple(notes))

    def _held(self, size: int, count: int) -> int:
        """Return the bytes of the frames of a sequence that are held at a time.

        Args:
            size: Bytes of the largest frame.
            count: Number of frames.

        Raises:
            Refusal: They are more than all requests may have.
        """
        model = self.loaded.model
        copies = min(count, 1 + 2 * max(model.frame_halo, model.frames)) if model.frames else 1
        if copies * size > self.budget.total:
            raise Refusal(
                422,
                f"the model sees {copies} frames at a time, which take {copies * size / 1e6:.0f} MB, at most "
                f"{self.budget.total / 1e6:.0f} MB are taken; send smaller or fewer frames",
            )
        return copies * size

    def _denoiser(self, clip: Clip, wish: Wish, ticket: Ticket, notes: dict[str, None]) -> ClipDenoiser:
        factor = wish.exposure if isinstance(wish.exposure, float) else None
        settings = replace(
            self.settings,
            exposure=factor,
            measure_exposure=wish.exposure == "auto",
            run=partial(self.batcher.run, ticket),
        )

        def say(text: str, kind: str = "note", /) -> None:
            notes[f"{kind}: {text}"] = None

        cls = SequenceDenoiser if self.loaded.model.frames else ClipDenoiser
        return cls(self.loaded, clip, settings, say)

    def _read(self, folder: Path, path: Path, wish: Wish, ticket: Ticket, notes: dict[str, None]) -> Frame:
        frame, remarks = self.readers.read(folder, str(path), wish.layers, ticket)
        if replaced := replaced_pixels(frame):
            remarks = [*remarks, f"{path.name}: {replaced}"]
        notes.update(dict.fromkeys(f"note: {remark}" for remark in remarks))
        return frame


class _Sink:
    """Where the results of a request go: one EXR file, or a ZIP of them for a ZIP.

    Args:
        place: Of the request.
        single: Name of the file where it is one EXR.
        wish: What is wanted.
    """

    def __init__(self, place: Place, single: str | None, wish: Wish) -> None:
        self.place, self.single, self.wish = place, single, wish
        self.folder = place.upload / "denoised"
        self.folder.mkdir()
        self.path = self.folder / (single or "denoised.zip")
        self.archive = None if single else zipfile.ZipFile(self.path, "x")
        self.exposure, self.pixels = 0.0, 0

    def add(self, item: Item, result: Result) -> None:
        """Write a frame."""
        target = self.folder / f"{item.name}.exr"
        # Compression may fail to make it smaller; a ZIP file holds it for a second time until it is removed.
        most = 2 * (result.frame.buffers["color"].nbytes + _HEADERS)
        self.place.take(most)
        write_frame(result.frame, target, single=self.wish.single)
        self.place.give_back(most - target.stat().st_size)
        self.exposure = self.exposure or result.exposure
        self.pixels += result.frame.height * result.frame.width
        if self.archive is not None:
            self.archive.write(target, target.name)
            target.unlink()

    def close(self) -> None:
        """Complete the ZIP file."""
        if self.archive is not None:
            self.archive.close()

    def done(self, notes: tuple[str, ...]) -> Done:
        """Return the result."""
        kind = EXR if self.single else ZIP
        return Done(self.path, kind, notes, self.exposure, self.pixels)
