"""Writes the shards of one scene: reads its frames once, in order, and cuts every patch out of them.

What is cut follows from the manifest, the options and the pixels of the frame, so scenes can be done by
several processes, and again.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.derive import derive
from data.frame import Frame
from data.frames import FrameSet
from data.importance import importance_candidates, importance_map
from data.manifest import FrameRecord
from data.patches import Position
from data.shards.division import Candidate, Place, ShardPlan
from data.shards.index import write_json
from data.shards.options import PrepareOptions
from data.shards.planes import SAMPLES, Planes
from data.shards.write import ShardWriter
from data.temporal import Accumulator

CUT_VERSION = 1
"""Part of the name of automatically prepared shards. Raise it whenever the same frames and options give
other samples than before: when accumulation (`data.temporal`), derivation (`data.derive`), repair, cutting or
the choice of positions (`data.patches`, `data.importance`) change. Otherwise shards in a cache, made by the
earlier code, would be taken for current ones."""


def make_scene(
    root: str,
    scene: str,
    plans: list[ShardPlan],
    options: PrepareOptions,
    work: str,
    report: Callable[[], None] | None = None,
) -> None:
    """Write the given shards of one scene, and a record of each when it is finished."""
    wanted: dict[int, list[tuple[ShardPlan, Place]]] = {}
    for plan in plans:
        for index, place in plan.samples:
            wanted.setdefault(index, []).append((plan, place))
    left = Counter({plan.file: len(plan.samples) for plan in plans})
    with contextlib.ExitStack() as stack:
        writers: dict[str, ShardWriter] = {}
        for frame in _frames(FrameSet(root), scene, options, set(wanted)):
            cutter = _Cutter(frame, options)
            for plan, place in wanted.pop(frame.index):
                if plan.file not in writers:
                    path = Path(work) / "shards" / plan.file
                    writers[plan.file] = stack.enter_context(ShardWriter(path, plan.split, plan.scene))
                cutter.add(writers[plan.file], place)
                left[plan.file] -= 1
                if left[plan.file] == 0:
                    record = writers.pop(plan.file).finish()
                    write_json(Path(work) / "records" / f"{plan.file}.json", record.to_dict())
                    if report is not None:
                        report()


def _frames(frames: FrameSet, scene: str, options: PrepareOptions, wanted: set[int]) -> Iterator[Frame]:
    """Yield the wanted frames of a scene; accumulation has to read those before them too."""
    record = frames.manifest.scenes[scene]
    last = max(wanted)
    if not (options.accumulate and record.sequence):
        for kept in record.frames:
            if kept.index in wanted:
                yield frames.read(scene, kept.index, _needed(kept, options))
        return
    for frame in _accumulated(frames, scene, **record.thresholds):
        if frame.index in wanted:
            yield frame
        if frame.index >= last:
            return


def _needed(record: FrameRecord, options: PrepareOptions) -> list[str]:
    """Return those buffers that are stored or looked at, and that the frame has or lets derive."""
    looked_at = ("color",) if options.sampling == "importance" else ()
    names = dict.fromkeys((*options.stored, *looked_at))
    return [name for name in names if name in record.buffers or name in record.derived]


def _accumulated(frames: FrameSet, scene: str, **thresholds: float) -> Iterator[Frame]:
    accumulator = Accumulator(**thresholds)
    for frame in frames.sequence(scene):
        yield frame if frame.accumulated else accumulator.step(frame)


@dataclass(frozen=True)
class _Kept:
    """What is stored of a frame: its planes, what each sample's JSON says, and its samples' kind."""

    planes: dict[str, Planes]
    meta: dict[str, Any]
    per_sample: tuple[int, tuple[str, ...]] | None


class _Cutter:
    """Cuts one frame.

    Args:
        frame: With every buffer that is wanted.
        options: How.

    Raises:
        ValueError: A buffer is missing or holds values that are not finite.
    """

    def __init__(self, frame: Frame, options: PrepareOptions) -> None:
        self.frame, self.options = frame, options
        self.kept = _keep(frame, options)
        self._positions: dict[tuple[str, int], list[Position | None]] = {}
        self._map: Any = None

    def add(self, writer: ShardWriter, place: Place) -> None:
        """Append the sample at a place, unless it was pruned or its reference is black."""
        position = place
        if isinstance(place, Candidate):
            position = self._candidates(writer.split, place.total)[place.number]
            if position is None:
                writer.pruned += 1
                return
        assert not isinstance(position, Candidate)
        patch, planes = self.options.patch_size, self.kept.planes
        if position is not None and planes["reference"].black(position, patch):
            writer.skipped += 1  # a black target teaches nothing [authors' code of Fan et al. 2021]
            return
        arrays = {name: plane.cut(position, patch) for name, plane in planes.items()}
        height, width = arrays["reference"].shape[-2:]
        x, y = position if position is not None else (0, 0)
        writer.per_sample = self.kept.per_sample
        writer.add_stored({**self.kept.meta, "x": x, "y": y, "width": width, "height": height}, arrays)

    def _candidates(self, split: str, count: int) -> list[Position | None]:
        known = self._positions.get((split, count))
        if known is None:
            frame, options = self.frame, self.options
            if self._map is None:
                frame.require("color")
                self._map = importance_map(
                    frame.buffers["color"],
                    frame.buffers.get("normal"),
                    options.patch_size,
                    options.importance_floor,
                )
            seed = (options.seed, "importance", split, frame.scene, frame.index)
            known = importance_candidates(self._map, count, options.patch_size, seed, frame.label)
            self._positions[split, count] = known
        return known


def _keep(frame: Frame, options: PrepareOptions) -> _Kept:
    frame.require("reference", *options.buffers)
    if "history" in options.stored and "irradiance" in frame.buffers and not frame.accumulated:
        frame = derive(frame, ["history"])
    buffers = {name: frame.buffers[name] for name in options.stored if name in frame.buffers}
    depth = frame.buffers.get("depth")
    meta = {
        "scene": frame.scene,
        "frame": frame.index,
        "exposure": 1.0 if frame.exposure is None else float(frame.exposure),
        "depth_range": [0.0, 0.0] if depth is None else [float(depth.min()), float(depth.max())],
        "accumulated": frame.accumulated,
    }
    try:
        planes = {name: Planes.of(name, array) for name, array in buffers.items()}
        if frame.samples is None or options.samples == "none":
            return _Kept(planes, meta, None)
        planes[SAMPLES] = Planes.of_samples(frame.samples, options.samples == "half")
    except ValueError as error:
        raise ValueError(f"{frame.label}: {error}") from error
    meta["sample_channels"] = list(frame.samples.channels)
    return _Kept(planes, meta, (frame.samples.count, frame.samples.channels))
