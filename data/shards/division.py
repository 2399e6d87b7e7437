"""Decides which patch goes into which shard.

All of it follows from the manifest and the options, never from pixels. Uniform positions are drawn here. For
importance sampling the plan deals out numbered candidates; who cuts a frame draws their positions and finds
out which are pruned, and those are simply not written. So a shard holds the same samples whoever makes it,
and whichever others exist already.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from data.frames import FrameSet
from data.manifest import FrameRecord
from data.patches import (
    LEGACY_TRAIN,
    Position,
    check_size,
    generator_of,
    legacy_positions,
    patch_count,
    uniform_positions,
)
from data.shards.clips import clip_counts, lacking, listed
from data.shards.options import PrepareOptions

FRAMES_PER_SHARD = 8
"""Whole frames in a shard of the test split."""

MIN_TRAIN_SHARDS = 8
"""Training samples are spread over at least so many shards, so that a small set can serve several ranks."""


class Candidate(NamedTuple):
    """A patch whose position follows from the pixels: number `number` of `total` candidates of a frame."""

    number: int
    total: int


Kind = tuple[int | None, tuple[str, ...]] | None
"""Samples per pixel that a frame keeps apart and their quantities; None: it keeps none."""

Place = Position | Candidate | None
"""Where a sample is cut: a position, a candidate, or None for the whole frame."""


@dataclass(frozen=True)
class ShardPlan:
    """One shard to be written: its samples as index of the first frame and place.

    `frames`: consecutive frames of a sample.
    """

    file: str
    split: str
    scene: str
    samples: tuple[tuple[int, Place], ...]
    frames: int = 1


@dataclass(frozen=True)
class _Source:
    """The frames that a split is cut from: scene → records; `own`: no other split is cut from them."""

    scenes: dict[str, list[FrameRecord]]
    own: bool = True


def plan_shards(frames: FrameSet, options: PrepareOptions) -> list[ShardPlan]:
    """Return all shards of a data set, in the order of split, scene and frame.

    Raises:
        ValueError: No frame is for training, no scene has as many consecutive frames as a clip, a frame is
            smaller than a patch, or samples that are kept apart do not agree or are asked for in clips.
    """
    plans = []
    sources = _sources(frames, options)
    _check_samples(frames, sources, options)
    for split, source in sources.items():
        lists = {scene: _scene_samples(frames, scene, split, source, options) for scene in source.scenes}
        limit = FRAMES_PER_SHARD if split == "test" else options.samples_per_shard
        if split == "train":
            limit = min(limit, max(1, sum(map(len, lists.values())) // MIN_TRAIN_SHARDS))
        frames_each = 1 if split == "test" else options.frames
        number = 0
        for scene, samples in lists.items():
            for part in _parts(samples, limit):
                file = f"{split}-{number:05d}.tar"
                plans.append(ShardPlan(file, split, scene, tuple(part), frames_each))
                number += 1
    return plans


def _sources(frames: FrameSet, options: PrepareOptions) -> dict[str, _Source]:
    chosen = {split: _selected(frames, split, options) for split in ("train", "validation", "test")}
    if not frames.scenes("train"):
        raise ValueError(
            f"{frames.root} has no scene in split train; ingest again with fewer held-out scenes"
        )
    if not chosen["train"]:
        known = sorted({r.spp for s in frames.scenes("train") for r in frames.frames(s) if r.spp is not None})
        raise ValueError(
            f"{frames.root} has no training frame with --spp {' '.join(map(str, options.spp))}; its frames "
            f"have {', '.join(map(str, known)) or 'no record of their'} samples per pixel"
        )
    _leave_out_short(frames, chosen, options)
    train, validation = _Source(chosen["train"]), _Source(chosen["validation"])
    if not frames.scenes("validation"):
        validation = _Source(chosen["train"], own=False)
        if options.validation_share > 0:
            train, validation = _held_out(chosen["train"], options)
    return {"train": train, "validation": validation, "test": _Source(chosen["test"])}


def _selected(frames: FrameSet, split: str, options: PrepareOptions) -> dict[str, list[FrameRecord]]:
    found = {scene: chosen_frames(frames, scene, options) for scene in frames.scenes(split)}
    return {scene: records for scene, records in found.items() if records}


def chosen_frames(frames: FrameSet, scene: str, options: PrepareOptions) -> list[FrameRecord]:
    """Return the frames of a scene with the samples per pixel that are asked for, in ascending order."""
    return [r for r in frames.frames(scene) if not options.spp or r.spp in options.spp]


def left_out(frames: FrameSet, options: PrepareOptions) -> list[str]:
    """Return what to say of scenes for training and validation that no clip fits into: a line, or none."""
    chosen = {**_selected(frames, "train", options), **_selected(frames, "validation", options)}
    short = lacking(frames, chosen, options.frames)
    many = f"{len(short)} scenes were" if len(short) > 1 else "1 scene was"
    needed = f"clips need {options.frames} consecutive frames of a sequence"
    return [f"{many} left out, {needed}: {listed(short)}"] if short else []


def _leave_out_short(
    frames: FrameSet, chosen: dict[str, dict[str, list[FrameRecord]]], options: PrepareOptions
) -> None:
    """Take the scenes that no clip fits into out of training and validation.

    Raises:
        ValueError: Nothing is left; names them.
    """
    for split, kind in (("train", "training"), ("validation", "validation")):
        short = lacking(frames, chosen[split], options.frames)
        if short and len(short) == len(chosen[split]) and (split == "train" or options.validation_patches):
            moving = any(frames.manifest.scenes[scene].sequence for scene in short)
            way = "take shorter clips, --clip-frames N (in training --data.frames N), or longer sequences"
            raise ValueError(
                f"{frames.root} has no {kind} scene with {options.frames} consecutive frames of one "
                f"sequence: {listed(short)}; {way if moving else 'use data of sequences'}"
            )
        chosen[split] = {scene: records for scene, records in chosen[split].items() if scene not in short}


def _held_out(scenes: dict[str, list[FrameRecord]], options: PrepareOptions) -> tuple[_Source, _Source]:
    """Divide training frames by view: all samples per pixel of one view are on one side."""
    views = list(dict.fromkeys((scene, _view(r)) for scene, records in scenes.items() for r in records))
    number = min(max(1, round(options.validation_share * len(views))), len(views) - 1)
    order = generator_of((options.seed, "held out")).permutation(len(views))
    held = {views[i] for i in order[:number].tolist()}
    parts = []
    for wanted in (False, True):
        part = {
            scene: [r for r in records if ((scene, _view(r)) in held) == wanted]
            for scene, records in scenes.items()
        }
        parts.append(_Source({scene: records for scene, records in part.items() if records}))
    return parts[0], parts[1]


def _view(record: FrameRecord) -> tuple[str, int]:
    return ("frame", record.index) if record.view is None else ("view", record.view)


def _check_samples(frames: FrameSet, sources: dict[str, _Source], options: PrepareOptions) -> None:
    """Check, as far as the manifest tells, that batches of samples can be made."""
    if options.samples == "none":
        return
    kinds: dict[Kind, str] = {}
    for source in sources.values():
        for records in source.scenes.values():
            for record in records:
                kind = (record.spp, tuple(record.samples)) if record.samples else None
                kinds.setdefault(kind, record.file)
    apart = next((where for kind, where in kinds.items() if kind is not None), None)
    if options.frames > 1 and apart is not None:
        raise ValueError(
            f"{frames.root}: {apart} keeps samples apart, which clips do not hold; leave them out with "
            "--samples none (in training --data.recipe recurrent)"
        )
    if len(kinds) > 1:
        raise ValueError(f"{frames.root}: {different_samples(kinds)}")


def kind_of(stored: tuple[int, tuple[str, ...]] | None) -> Kind:
    """Return the kind of samples with these channels, as `ShardRecord.per_sample` has them."""
    if stored is None:
        return None
    return stored[0], tuple(dict.fromkeys(channel.partition(".")[0] for channel in stored[1]))


def different_samples(kinds: Mapping[Kind, str]) -> str:
    """Return what to tell about frames that keep different samples apart: which, how many, and the way out.

    Args:
        kinds: Samples per pixel and their quantities, None where a frame keeps none → where that is so.
    """
    alike = len({kind and kind[1] for kind in kinds}) == 1
    told = []
    for kind, where in kinds.items():
        number = "no samples" if kind is None else f"{kind[0] or 'an unknown number of'} samples per pixel"
        told.append(f"{where} has {number}" + ("" if kind is None or alike else f" of {', '.join(kind[1])}"))
    more = f" and {len(told) - 3} more kinds" if len(told) > 3 else ""
    return (
        "frames that keep different samples apart cannot be in one set of shards, whose batches need the "
        f"same number: {'; '.join(told[:3])}{more}. Choose frames with --spp N (in training --data.spp [N]), "
        "or leave samples out with --samples none"
    )


def _scene_samples(
    frames: FrameSet, scene: str, split: str, source: _Source, options: PrepareOptions
) -> list[tuple[int, Place]]:
    records = source.scenes[scene]
    if split == "test":
        return [(record.index, None) for record in records]
    number = _per_reference(split, source, options)
    counts = _counts(records, number, (options.seed, "clips", split, scene), options.frames)
    samples: list[tuple[int, Place]] = []
    for record, count in counts:
        size = (record.width, record.height)
        label = f"{frames.root / record.file}"
        if options.sampling == "importance":
            check_size(size, options.patch_size, label)
            samples += [(record.index, Candidate(i, count)) for i in range(count)]
        else:
            seed = (options.seed, split, scene, record.index)
            draw = legacy_positions if options.wskp_legacy_crops else uniform_positions
            samples += [(record.index, p) for p in draw(count, size, options.patch_size, seed, label)]
    return samples


def _counts(
    records: list[FrameRecord], number: int, seed: tuple[int | str, ...], length: int
) -> list[tuple[FrameRecord, int]]:
    """Return how many patches, or clips that begin there, each frame gives."""
    if length == 1:
        return [(r, patch_count(number, r.width, r.height, ordinal)) for ordinal, r in enumerate(records)]
    begins = clip_counts(records, length, number, seed)
    return [(record, begins[record.index]) for record in records if record.index in begins]


def _per_reference(split: str, source: _Source, options: PrepareOptions) -> int:
    """Return the number of patches or candidates of a 1280x720 frame."""
    if options.sampling == "importance":
        if source.own:
            return options.candidates
        return round(options.candidates * options.validation_patches / options.train_patches)
    if split == "train":
        return LEGACY_TRAIN if options.wskp_legacy_crops else options.train_patches
    return options.validation_patches


def _parts(samples: list[Any], limit: int) -> Iterator[list[Any]]:
    """Split a list into as few parts as the limit allows, of sizes that differ by one at most."""
    count = -(-len(samples) // limit)
    for part in range(count):
        yield samples[part * len(samples) // count : (part + 1) * len(samples) // count]
