"""Writes the shards of one scene: reads its frames once, in order, and cuts every patch out of them.

Of clips as many frames as one has are held at a time, and a clip is cut when its last frame has been read.

What is cut follows from the manifest, the options and the pixels of the frame, so scenes can be done by
several processes, and again.
"""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data.buffers import SAMPLES, THIN_LENS
from data.exr import StoredFrame
from data.frames import FrameSet
from data.importance import importance_candidates, importance_map
from data.manifest import FrameRecord
from data.patches import Position
from data.shards.clips import clips_of
from data.shards.division import Candidate, Place, ShardPlan, chosen_frames, different_samples, kind_of
from data.shards.index import write_json
from data.shards.options import PrepareOptions
from data.shards.planes import Planes, Stored
from data.shards.write import ShardWriter
from data.temporal import Accumulator

CUT_VERSION = 2
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
    frames = FrameSet(root)
    clips = clips_of(chosen_frames(frames, scene, options), options.frames)
    wanted: dict[int, list[tuple[ShardPlan, Place]]] = {}  # by the last frame
    needed: set[int] = set()
    for plan in plans:
        for index, place in plan.samples:
            clip = (index,) if plan.frames == 1 else clips[index]
            wanted.setdefault(clip[-1], []).append((plan, place))
            needed.update(clip)
    left = Counter({plan.file: len(plan.samples) for plan in plans})
    held: deque[_Cutter] = deque(maxlen=max(plan.frames for plan in plans))
    with contextlib.ExitStack() as stack:
        writers: dict[str, ShardWriter] = {}
        for stored in _frames(frames, scene, options, needed):
            held.append(_Cutter(stored, options))
            for plan, place in wanted.pop(stored.frame.index, ()):
                if plan.file not in writers:
                    path = Path(work) / "shards" / plan.file
                    writers[plan.file] = stack.enter_context(ShardWriter(path, plan.split, plan.scene))
                _add(writers[plan.file], place, list(held)[-plan.frames :], options)
                left[plan.file] -= 1
                if left[plan.file] == 0:
                    record = writers.pop(plan.file).finish()
                    write_json(Path(work) / "records" / f"{plan.file}.json", record.to_dict())
                    if report is not None:
                        report()


def _frames(frames: FrameSet, scene: str, options: PrepareOptions, wanted: set[int]) -> Iterator[StoredFrame]:
    """Yield the wanted frames of a scene; accumulation has to read those before them too."""
    record = frames.manifest.scenes[scene]
    samples = options.samples != "none"
    if options.accumulate and record.sequence:
        yield from _accumulated(frames, scene, options, wanted)
        return
    for kept in record.frames:
        if kept.index in wanted:
            computed = _known(kept, _looked_at(options))
            if "depth" in kept.buffers:
                computed.append("depth")
            yield frames.read_stored(scene, kept.index, _stored(kept, options), computed, samples=samples)


def _stored(record: FrameRecord, options: PrepareOptions) -> list[str]:
    """Return what is read to be stored: what the frame is known to have, and all that was asked for.

    Manifests say what is derived as a rule; more can be, such as specular light from the whole and its
    diffuse part.
    """
    asked = (name for name in options.buffers if name not in ("irradiance", "history"))
    return list(dict.fromkeys((*_known(record, options.stored), *asked)))


def _looked_at(options: PrepareOptions) -> tuple[str, ...]:
    """Return what the choice of positions depends on."""
    return ("color", "normal") if options.sampling == "importance" else ()


def _known(record: FrameRecord, names: Iterable[str]) -> list[str]:
    """Return those buffers that the frame has or lets derive."""
    return [name for name in names if name in record.buffers or name in record.derived]


def _accumulated(
    frames: FrameSet, scene: str, options: PrepareOptions, wanted: set[int]
) -> Iterator[StoredFrame]:
    found = frames.manifest.scenes[scene]
    accumulators: dict[int | None, Accumulator] = {}
    samples = options.samples != "none"
    needed = ("irradiance", "position", "normal", "motion", "depth", *_looked_at(options))
    for record in found.frames:
        computed = _known(record, needed)
        frame, halves = frames.read_stored(
            scene, record.index, _stored(record, options), computed, samples=samples
        )
        if not frame.accumulated:
            level = None if record.view is None else record.spp  # each is a sequence of its own
            if level not in accumulators:
                accumulators[level] = Accumulator(**found.thresholds)
            frame = accumulators[level].step(frame)
            halves = {
                name: planes for name, planes in halves.items() if name not in ("irradiance", "history")
            }
        if record.index in wanted:
            yield StoredFrame(frame, halves)
        if record.index >= max(wanted):
            return


def _planes(stored: StoredFrame, name: str) -> Planes:
    half = stored.halves.get(name)
    return Planes.of(name, stored.frame.buffers[name]) if half is None else Planes(name, half, True)


@dataclass(frozen=True)
class _Kept:
    """What is stored of a frame: its planes, what each sample's JSON says, and its samples' kind."""

    planes: dict[str, Planes]
    meta: dict[str, Any]
    per_sample: tuple[int, tuple[str, ...]] | None


def _add(writer: ShardWriter, place: Place, cutters: Sequence[_Cutter], options: PrepareOptions) -> None:
    """Append the sample at a place, unless it was pruned or its reference is black, in all frames of a clip.

    Args:
        writer: Of its shard.
        place: Where it is cut; the first frame decides about a candidate.
        cutters: The frame that it is cut from, or those of a clip.
        options: How.
    """
    position, first = place, cutters[0]
    if isinstance(position, Candidate):
        position = first.candidates(writer.split, position.total)[position.number]
        if position is None:
            writer.pruned += 1
            return
    patch = options.patch_size
    if position is not None and all(c.kept.planes["reference"].black(position, patch) for c in cutters):
        writer.skipped += 1  # a black target teaches nothing [authors' code of Fan et al. 2021]
        return
    parts = [{name: p.cut(position, patch) for name, p in c.kept.planes.items()} for c in cutters]
    meta, arrays = first.kept.meta, parts[0]
    if len(cutters) > 1:
        meta, arrays = _joined(cutters, parts)
    height, width = arrays["reference"].shape[-2:]
    x, y = position if position is not None else (0, 0)
    first.check_kind(writer)
    writer.add_stored({**meta, "x": x, "y": y, "width": width, "height": height}, arrays)


def _joined(
    cutters: Sequence[_Cutter], parts: Sequence[dict[str, Stored]]
) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Return what the JSON of a clip says, and its arrays (N, C, H, W).

    An array that one frame needs in float32 is kept so for all; the others keep the values that half
    precision gave them.

    Raises:
        ValueError: The frames differ in what they hold.
    """
    first = cutters[0]
    for cutter, part in zip(cutters, parts, strict=True):
        if part.keys() != parts[0].keys():
            kinds = [f"{c.frame.label} has {', '.join(c.kept.planes)}" for c in (first, cutter)]
            raise ValueError(
                f"frames of one clip hold different buffers: {'; '.join(kinds)}; name those that all have: "
                "--only A,B"
            )
        if cutter.frame.accumulated != first.frame.accumulated:
            raise ValueError(
                f"{cutter.frame.label} and {first.frame.label} are in one clip, and one of them is "
                "accumulated; accumulate the others too: --accumulate"
            )
    meta = {
        **first.kept.meta,
        "depth_range": [cutter.kept.meta["depth_range"] for cutter in cutters],
        "frames": len(cutters),
    }
    return meta, {name: np.stack([part[name] for part in parts]) for name in parts[0]}


class _Cutter:
    """Cuts one frame.

    Args:
        stored: With every buffer that is wanted.
        options: How.

    Raises:
        ValueError: A buffer is missing or holds values that are not finite.
    """

    def __init__(self, stored: StoredFrame, options: PrepareOptions) -> None:
        self.frame, self.options = stored.frame, options
        self.kept = _keep(stored, options)
        self._positions: dict[tuple[str, int], list[Position | None]] = {}
        self._map: Any = None

    def check_kind(self, writer: ShardWriter) -> None:
        """Check that the samples of a shard are all of one kind, which a manifest can have wrong."""
        kind = self.kept.per_sample
        if writer.samples and writer.per_sample != kind:
            kinds = {kind_of(writer.per_sample): f"an earlier frame of {self.frame.scene}"}
            raise ValueError(different_samples(kinds | {kind_of(kind): self.frame.label}))
        writer.per_sample = kind

    def candidates(self, split: str, count: int) -> list[Position | None]:
        """Return the positions of all candidates of the frame, None where one is pruned."""
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


def _keep(stored: StoredFrame, options: PrepareOptions) -> _Kept:
    frame, halves = stored
    frame.require(*(name for name in ("reference", *options.buffers) if name not in halves))
    has = frame.buffers.keys() | halves.keys()
    if {"history"} - has and "history" in options.stored and "irradiance" in has and not frame.accumulated:
        halves = {**halves, "history": np.ones((1, frame.height, frame.width), np.float16)}
        has |= {"history"}
    depth = frame.buffers.get("depth")
    meta = {
        "scene": frame.scene,
        "frame": frame.index,
        "exposure": 1.0 if frame.exposure is None else float(frame.exposure),
        "depth_range": [0.0, 0.0] if depth is None else [float(depth.min()), float(depth.max())],
        "accumulated": frame.accumulated,
    }
    try:
        planes = {name: _planes(StoredFrame(frame, halves), name) for name in options.stored if name in has}
        if frame.samples is None or options.samples == "none":
            return _Kept(planes, meta, None)
        planes[SAMPLES] = Planes.of_samples(frame.samples, options.samples == "half")
    except ValueError as error:
        raise ValueError(f"{frame.label}: {error}") from error
    meta["sample_channels"] = list(frame.samples.channels)
    if frame.thin_lens is not None:
        meta[THIN_LENS] = list(frame.thin_lens)
    return _Kept(planes, meta, (frame.samples.count, frame.samples.channels))
