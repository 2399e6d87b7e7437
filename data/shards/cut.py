"""Decides which patch goes into which shard, and writes the shards of one scene.

All of it follows from the manifest and the options, so scenes can be done by several processes, and again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data.buffers import buffer
from data.derive import derive
from data.frame import Frame
from data.frames import FrameSet
from data.patches import LEGACY_TRAIN, Position, cut, legacy_positions, patch_count, uniform_positions
from data.shards.index import write_json
from data.shards.write import ShardWriter
from data.temporal import Accumulator

BUFFERS = ("color", "irradiance", "albedo", "normal", "depth", "history", "reference")
"""What shards hold of every frame that has it."""

CUT_VERSION = 1
"""Part of the name of automatically prepared shards. Raise it whenever the same frames and options give
other samples than before: when accumulation (`data.temporal`), derivation (`data.derive`), repair or cutting
change. Otherwise shards in a cache, made by the earlier code, would be taken for current ones."""

FRAMES_PER_SHARD = 8
"""Whole frames in a shard of the test split."""

MIN_TRAIN_SHARDS = 8
"""Training samples are spread over at least so many shards, so that a small set can serve several ranks."""


@dataclass(frozen=True)
class PrepareOptions:
    """How frames become shards.

    Attributes:
        patch_size: Width and height of training and validation patches.
        train_patches: Training patches per 1280x720 frame; other sizes keep the density.
        validation_patches: Validation patches per 1280x720 frame.
        samples_per_shard: Largest number of patches in a shard.
        accumulate: Accumulate irradiance over the preceding frames of a sequence.
        seed: Seed of the patch positions.
        wskp_legacy_crops: Positions and number as in the authors' script of WSKP (77 crops, zero padding).
        buffers: Buffers to keep beside `BUFFERS`.
    """

    patch_size: int = 128
    train_patches: int = 80
    validation_patches: int = 20
    samples_per_shard: int = 256
    accumulate: bool = True
    seed: int = 1
    wskp_legacy_crops: bool = False
    buffers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, low in (("patch_size", 1), ("train_patches", 1), ("validation_patches", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {low}")
        if self.samples_per_shard < 1:
            raise ValueError(f"samples_per_shard is {self.samples_per_shard}; expected at least 1")
        for name in self.buffers:
            buffer(name)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {**asdict(self), "buffers": list(self.buffers)}


@dataclass(frozen=True)
class ShardPlan:
    """One shard to be written: its samples as frame index and patch position, None for the whole frame."""

    file: str
    split: str
    scene: str
    samples: tuple[tuple[int, Position | None], ...]


def plan_shards(frames: FrameSet, options: PrepareOptions) -> list[ShardPlan]:
    """Return all shards of a data set, in the order of split, scene and frame.

    Raises:
        ValueError: No scene is for training, or a frame is smaller than a patch.
    """
    if not frames.scenes("train"):
        raise ValueError(
            f"{frames.root} has no scene in split train; ingest again with fewer held-out scenes"
        )
    own_validation = frames.scenes("validation")
    sources = {
        "train": frames.scenes("train"),
        "validation": own_validation or frames.scenes("train"),
        "test": frames.scenes("test"),
    }
    plans = []
    for split, scenes in sources.items():
        lists = {scene: _scene_samples(frames, scene, split, options) for scene in scenes}
        limit = FRAMES_PER_SHARD if split == "test" else options.samples_per_shard
        if split == "train":
            limit = min(limit, max(1, sum(map(len, lists.values())) // MIN_TRAIN_SHARDS))
        number = 0
        for scene, samples in lists.items():
            for part in _parts(samples, limit):
                plans.append(ShardPlan(f"{split}-{number:05d}.tar", split, scene, tuple(part)))
                number += 1
    return plans


def _scene_samples(
    frames: FrameSet, scene: str, split: str, options: PrepareOptions
) -> list[tuple[int, Position | None]]:
    records = frames.frames(scene)
    if split == "test":
        return [(record.index, None) for record in records]
    number = options.train_patches if split == "train" else options.validation_patches
    if options.wskp_legacy_crops and split == "train":
        number = LEGACY_TRAIN
    draw = legacy_positions if options.wskp_legacy_crops else uniform_positions
    samples: list[tuple[int, Position | None]] = []
    for ordinal, record in enumerate(records):
        size = (record.width, record.height)
        seed = (options.seed, split, scene, record.index)
        label = f"{frames.root / record.file}"
        count = patch_count(number, *size, ordinal)
        samples += [(record.index, p) for p in draw(count, size, options.patch_size, seed, label)]
    return samples


def _parts(samples: list[Any], limit: int) -> Iterator[list[Any]]:
    """Split a list into as few parts as the limit allows, of sizes that differ by one at most."""
    count = -(-len(samples) // limit)
    for part in range(count):
        yield samples[part * len(samples) // count : (part + 1) * len(samples) // count]


def make_scene(
    root: str,
    scene: str,
    plans: list[ShardPlan],
    options: PrepareOptions,
    work: str,
    report: Callable[[], None] | None = None,
) -> None:
    """Write the given shards of one scene, and a record of each when it is finished."""
    wanted: dict[int, list[tuple[ShardPlan, Position | None]]] = {}
    for plan in plans:
        for index, position in plan.samples:
            wanted.setdefault(index, []).append((plan, position))
    left = {plan.file: len(plan.samples) for plan in plans}
    with contextlib.ExitStack() as stack:
        writers: dict[str, ShardWriter] = {}
        for frame in _frames(FrameSet(root), scene, options, set(wanted)):
            stored = _stored(frame, options)
            for plan, position in wanted.get(frame.index, ()):
                writer = writers.get(plan.file)
                if writer is None:
                    path = Path(work) / "shards" / plan.file
                    writer = stack.enter_context(ShardWriter(path, plan.split, plan.scene))
                    writers[plan.file] = writer
                _add(writer, stored, position, options.patch_size)
                left[plan.file] -= 1
                if left[plan.file] == 0:
                    record = writer.finish()
                    write_json(Path(work) / "records" / f"{plan.file}.json", record.to_dict())
                    del writers[plan.file]
                    if report is not None:
                        report()


def _frames(frames: FrameSet, scene: str, options: PrepareOptions, wanted: set[int]) -> Iterator[Frame]:
    """Yield the wanted frames of a scene; accumulation has to read those before them too."""
    record = frames.manifest.scenes[scene]
    last = max(wanted)
    if not (options.accumulate and record.sequence):
        yield from (frames.read(scene, index) for index in sorted(wanted))
        return
    for frame in _accumulated(frames, scene, **record.thresholds):
        if frame.index in wanted:
            yield frame
        if frame.index >= last:
            return


def _accumulated(frames: FrameSet, scene: str, **thresholds: float) -> Iterator[Frame]:
    accumulator = Accumulator(**thresholds)
    for frame in frames.sequence(scene):
        yield frame if frame.accumulated else accumulator.step(frame)


def _stored(frame: Frame, options: PrepareOptions) -> Frame:
    """Return the frame with the buffers that go into shards and no others."""
    names = [*BUFFERS, *(name for name in options.buffers if name not in BUFFERS)]
    frame.require("reference", *options.buffers)
    if "irradiance" in frame.buffers and "history" not in frame.buffers and not frame.accumulated:
        frame = derive(frame, ["history"])
    kept = Frame(
        {name: frame.buffers[name] for name in names if name in frame.buffers},
        frame.scene,
        frame.index,
        exposure=frame.exposure,
        accumulated=frame.accumulated,
    )
    depth = frame.buffers.get("depth")
    kept.notes["depth_range"] = [0.0, 0.0] if depth is None else [float(depth.min()), float(depth.max())]
    return kept


def _add(writer: ShardWriter, frame: Frame, position: Position | None, patch: int) -> None:
    arrays = frame.buffers
    x, y = position if position is not None else (0, 0)
    if position is not None:
        arrays = {name: cut(array, position, patch) for name, array in arrays.items()}
        if not arrays["reference"].any():
            writer.skipped += 1  # a black target teaches nothing [authors' code of Fan et al. 2021]
            return
    height, width = arrays["reference"].shape[:2]
    meta = {
        "scene": frame.scene,
        "frame": frame.index,
        "x": x,
        "y": y,
        "width": width,
        "height": height,
        "exposure": 1.0 if frame.exposure is None else float(frame.exposure),
        "depth_range": frame.notes["depth_range"],
        "accumulated": frame.accumulated,
    }
    try:
        writer.add(meta, arrays)
    except ValueError as error:
        raise ValueError(f"{frame.label}: {error}") from error
