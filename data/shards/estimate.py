"""How large shards will be, said and checked before they are made."""

from __future__ import annotations

import errno
import shutil
from dataclasses import dataclass
from pathlib import Path

from data.buffers import SAMPLE_BUFFERS, buffer, sample_channels
from data.frames import FrameSet
from data.importance import PUBLISHED_SHARE
from data.manifest import FrameRecord
from data.progress import size_text
from data.shards.division import Candidate, plan_shards
from data.shards.options import PrepareOptions

_SAMPLE_OVERHEAD = 2400
"""Bytes of a sample beside its arrays: two tar headers, the JSON and padding."""


@dataclass(frozen=True)
class Estimate:
    """What a preparation will give.

    Attributes:
        patches: Training and validation patches, or clips; those with a black reference are counted, and of
            candidates of importance sampling the share that AFGSA kept, which differs from frame to frame.
        frames: Whole frames of the test split.
        bytes: Size of all shards, if every buffer that may be half precision is.
        clip_frames: Frames of a clip, 1 of patches.
    """

    patches: int
    frames: int
    bytes: int
    clip_frames: int = 1


def estimate(frames: FrameSet, options: PrepareOptions) -> Estimate:
    """Return what cutting a data set will give.

    Raises:
        ValueError: It cannot be cut with these options.
    """
    records = {(s, r.index): r for s in frames.scenes() for r in frames.frames(s)}
    whole, patches, size = 0, 0.0, 0.0
    for plan in plan_shards(frames, options):
        for index, place in plan.samples:
            record = records[plan.scene, index]
            pixels = record.width * record.height if place is None else options.patch_size**2
            share = PUBLISHED_SHARE if isinstance(place, Candidate) else 1.0
            size += share * (plan.frames * pixels * _bytes_per_pixel(record, options) + _SAMPLE_OVERHEAD)
            whole += place is None
            patches += 0.0 if place is None else share
    return Estimate(round(patches), whole, round(size), options.frames)


def announcement(root: Path, output: Path, expected: Estimate) -> str:
    """Return the line that is shown before shards are made in the cache."""
    clips = f"clips of {expected.clip_frames} frames"
    kind = "patches" if expected.clip_frames == 1 else clips
    return (
        f"preparing {root.absolute().name}: {expected.patches} {kind} and {expected.frames} whole frames, "
        f"about {size_text(expected.bytes)}, in {output}; to choose the place: trainer prepare {root} "
        "--output DIR --processes N, then --data.root DIR"
    )


def check_room(root: Path, output: Path, expected: Estimate) -> None:
    """Check that the disk has room for shards, less what an interrupted call made already.

    Raises:
        OSError: It has not.
    """
    begun = output.with_name(output.name + ".partial") / "shards"
    needed = expected.bytes - sum(path.stat().st_size for path in begun.glob("*.tar"))
    free = shutil.disk_usage(output.parent).free
    if needed > free:
        raise OSError(
            errno.ENOSPC,
            f"shards of {root} take about {size_text(needed)}, and {size_text(free)} are free; make room, "
            f"set PENUMBRA_CACHE to a folder on another disk, or choose one: trainer prepare {root} "
            "--output DIR",
            str(output.parent),
        )


def _bytes_per_pixel(record: FrameRecord, options: PrepareOptions) -> int:
    has = {*record.buffers, *record.derived, "history"}
    names = [name for name in options.stored if name in has]
    plain = sum(buffer(name).channels * (2 if buffer(name).half else 4) for name in names)
    if options.samples == "none" or not record.samples:
        return plain
    half = options.samples == "half" or all(SAMPLE_BUFFERS[name].half for name in record.samples)
    return plain + (record.spp or 1) * len(sample_channels(*record.samples)) * (2 if half else 4)
