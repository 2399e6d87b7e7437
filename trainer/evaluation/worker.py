"""One method on all frames, in a process of its own.

The worker tells one JSON object a line (`facts`, `row`, `say`, `within`, `reason`) and hears, after it told
the model's `facts`, the names of frames that are there already. Results are written before their row is told,
so that a row means a picture.
"""

from __future__ import annotations

import inspect
import json
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from data.exr_image import write_exr
from data.frame import Frame, Image
from data.manifest import file_sha256
from trainer.clips import Clip, Item
from trainer.denoising import ClipDenoiser, Result, Settings
from trainer.evaluation.plan import INPUT, PLACES, REFERENCE, Method, Setting, clips_of
from trainer.inputs import replaced_pixels
from trainer.loading import Loaded, resolve
from trainer.outputs import replacing

PACKAGES = ("penumbra-denoise", "torch", "onnxruntime", "numba", "pyoidn")
"""Whose releases results depend on."""


@dataclass(frozen=True)
class Task:
    """What a worker does.

    Attributes:
        model: As `--model` of `trainer denoise`.
        options: Of a method that is named by its class.
        root: The data set.
        split: Which part of it, None for all.
        images: Folder that all images go to.
        folder: The method's own folder below it.
        device: Where it runs.
        memory: Bytes that it may take for a call.
        threads: Of PyTorch; 0: its own choice.
        only: Names of the frames that are wanted; empty: all.
    """

    model: str
    options: tuple[str, ...]
    root: str
    split: str | None
    images: str
    folder: str
    device: str = "cpu"
    memory: int = 2 * 1024**3
    threads: int = 0
    only: tuple[str, ...] = ()

    @staticmethod
    def of(method: Method, setting: Setting) -> Task:
        """Return what a worker does for a method."""
        return Task(
            method.model, method.options, setting.root, setting.split, str(setting.folder / "images"),
            method.folder, setting.device, setting.memory,
        )  # fmt: skip


class Worker:
    """Denoises clips and tells about it.

    Args:
        task: What to do.
        heard: Where answers come from.
        out: Where to tell.
    """

    def __init__(self, task: Task, heard: TextIO, out: TextIO) -> None:
        self.task, self.heard, self.out = task, heard, out
        self.images = Path(task.images)
        self._share, self._told = 0.0, 0.0

    def tell(self, **message: Any) -> None:
        """Write one line."""
        print(json.dumps(message), file=self.out, flush=True)

    def say(self, text: str, kind: str = "note", /) -> None:
        """Pass a remark on."""
        self.tell(say=text, kind=kind)

    def within(self, frames: float) -> None:
        """Pass on that the work went on by a fraction of a frame."""
        self._share += frames
        if time.monotonic() - self._told > 0.2:
            self.tell(within=self._share)
            self._share, self._told = 0.0, time.monotonic()

    def run(self) -> None:
        """Denoise everything that is not there yet.

        Raises:
            ValueError: The model cannot be loaded.
            OSError: The data set cannot be read, or a result not written.
        """
        loaded = resolve(self.task.model, self.task.device, options=self.task.options)
        self.tell(facts=facts_of(loaded))
        there = set(json.loads(self.heard.readline() or "[]"))
        clips, _ = clips_of(self.task.root, self.task.split or "all")
        for clip in clips:
            for part in parts(clip):
                wanted = [item.name for item in part.items if item.name in (self.task.only or (item.name,))]
                if any(name not in there for name in wanted):
                    self.clip(loaded, part)

    def clip(self, loaded: Loaded, clip: Clip) -> None:
        """Denoise the frames of a clip; one that fails is told with its reason, the others go on."""
        from trainer.sequences import denoiser_of

        settings = Settings(memory=self.task.memory, device=self.task.device, finite=False)
        denoiser = denoiser_of(loaded, clip, settings, self)
        previous: Frame | None = None
        waiting: list[Item] = []
        spent = 0.0
        for item in clip.items:
            waiting.append(item)
            try:
                frame = item.read()
                began = time.perf_counter()
                results = list(self.results(denoiser, clip, item, frame))
                spent += time.perf_counter() - began
            except (ValueError, OSError, RuntimeError, MemoryError) as error:
                reason = (str(error).splitlines() or [repr(error)])[0]
                failed, waiting = waiting, []
                for one in failed:
                    self.tell(row={"name": one.name, "status": "failed", "reason": reason})
                denoiser, previous, spent = denoiser_of(loaded, clip, settings, self), None, 0.0
                continue
            known = self.known(item, frame, previous) if self.task.folder == INPUT else {}
            previous = frame
            for done, result in results:
                waiting = [one for one in waiting if one.name != done.name]
                self.row(done, result, spent / len(results), known)
                spent = 0.0

    def results(
        self, denoiser: ClipDenoiser, clip: Clip, item: Item, frame: Frame
    ) -> Iterable[tuple[Item, Result]]:
        """Return what is finished with a frame."""
        yield from denoiser.push(item, frame)
        if item is clip.items[-1]:
            yield from denoiser.finish()

    def row(self, item: Item, result: Result, seconds: float, known: dict[str, Any]) -> None:
        """Write a result and tell of it, and what else is known of the frame."""
        image, frame = result.frame.buffers["color"], result.frame
        write_image(self.images / self.task.folder / f"{item.name}.exr", image)
        bad = int((~np.isfinite(image).all(-1)).sum())
        row = {
            "name": item.name,
            "scene": frame.scene,
            "frame": frame.index,
            "spp": frame.spp,
            "width": frame.width,
            "height": frame.height,
            "exposure": result.exposure,
            "reference": result.reference is not None,
            "seconds": seconds,
            "nonfinite": bad,
            "status": "nonfinite" if bad else "done",
            "reason": f"{bad} pixel{'s are' if bad > 1 else ' is'} NaN or Inf" if bad else None,
            **known,
        }
        self.tell(row=row)

    def known(self, item: Item, frame: Frame, previous: Frame | None) -> dict[str, Any]:
        """Write what is the same for all methods: the reference, and where pixels were before.

        Returns:
            Whether places were written, and how many pixels of the reference are not what its file holds.
        """
        repaired = int(frame.notes.get("repaired", {}).get("reference", 0))
        facts: dict[str, Any] = {"places": False, "repaired": repaired}
        if replaced := replaced_pixels(frame):
            self.say(f"{frame.label}: {replaced}", "warning")
        if "reference" in frame.buffers:
            write_image(self.images / REFERENCE / f"{item.name}.exr", frame.buffers["reference"])
        if previous is None or not frame.follows(previous):
            return facts
        from trainer.metrics.temporal import places_before

        try:
            places = places_before(frame, previous)
        except ValueError:
            return facts  # nothing says where its pixels were: no temporal metrics
        target = self.images / PLACES / f"{item.name}.npz"
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target) as temporary:
            np.savez_compressed(temporary, places=places)
        return facts | {"places": True}


def parts(clip: Clip) -> list[Clip]:
    """Return what can be denoised one without the other: single frames where they are independent views."""
    if clip.sequence:
        return [clip]
    return [Clip((item,), False, clip.depth, clip.thresholds) for item in clip.items]


def write_image(path: Path, image: Image) -> None:
    """Write radiance (H, W, 3) in float32, whatever it holds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {letter: np.ascontiguousarray(image[..., c], np.float32) for c, letter in enumerate("RGB")}
    write_exr(path, planes)


def facts_of(loaded: Loaded) -> dict[str, Any]:
    """Return what tables say about a method beside its label."""
    from models.denoiser import Denoiser

    model, source = loaded.model, loaded.source
    facts: dict[str, Any] = {"parameters": None, "deployed": None}
    if isinstance(model, Denoiser):
        networks = {"parameters": model, "deployed": loaded.deployed}
        facts = {
            name: sum(p.numel() for p in net.parameters())
            for name, net in networks.items()
            if isinstance(net, Denoiser)
        }
    return {
        **facts,
        "code": _code(model),
        "versions": {name: _version(name) for name in PACKAGES},
        "class": type(model).__name__ if isinstance(model, Denoiser) else model.description.model,
        "inputs": list(model.inputs),
        "options": source.init_args,
        "sha256": source.sha256,
        "step": source.step,
    }


def _code(model: Any) -> str:
    """Return the hash of the file that a model's class is written in, empty where there is none."""
    try:
        return file_sha256(Path(inspect.getfile(type(model))))
    except (TypeError, OSError):
        return ""


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def serve(task: Task, link: Connection, log: str, environment: dict[str, str]) -> None:
    """Do a task in a process that was forked for it, and end that with 1 where it could not be begun.

    Args:
        task: What to do.
        link: The other end of `Worker`'s streams.
        log: File for everything that is printed.
        environment: Variables; those of the process that forks are older.
    """
    import torch

    os.environ.clear()
    os.environ.update(environment)
    with open(log, "ab") as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
    if task.threads:
        torch.set_num_threads(task.threads)
    worker = Worker(task, os.fdopen(os.dup(link.fileno())), os.fdopen(os.dup(link.fileno()), "w"))
    try:
        worker.run()
    except (ValueError, OSError) as error:
        worker.tell(reason=(str(error).splitlines() or [repr(error)])[0])
        sys.exit(1)
