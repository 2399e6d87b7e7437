"""How large shards will be, said and checked before they are made."""

from __future__ import annotations

import errno
import shutil
from dataclasses import dataclass
from pathlib import Path

from data.buffers import buffer
from data.frames import FrameSet
from data.manifest import FrameRecord
from data.shards.cut import BUFFERS, PrepareOptions, plan_shards

_SAMPLE_OVERHEAD = 2400
"""Bytes of a sample beside its arrays: two tar headers, the JSON and padding."""


@dataclass(frozen=True)
class Estimate:
    """What a preparation will give.

    Attributes:
        patches: Training and validation patches; those with a black reference are counted.
        frames: Whole frames of the test split.
        bytes: Size of all shards, if every buffer that may be half precision is.
    """

    patches: int
    frames: int
    bytes: int


def estimate(frames: FrameSet, options: PrepareOptions) -> Estimate:
    """Return what cutting a data set will give.

    Raises:
        ValueError: It cannot be cut with these options.
    """
    records = {(s, r.index): r for s in frames.scenes() for r in frames.frames(s)}
    patches = whole = size = 0
    for plan in plan_shards(frames, options):
        for index, position in plan.samples:
            record = records[plan.scene, index]
            pixels = record.width * record.height if position is None else options.patch_size**2
            size += pixels * _bytes_per_pixel(record, options) + _SAMPLE_OVERHEAD
            whole += position is None
            patches += position is not None
    return Estimate(patches, whole, size)


def announcement(root: Path, output: Path, expected: Estimate) -> str:
    """Return the line that is shown before shards are made in the cache."""
    return (
        f"preparing {root.absolute().name}: {expected.patches} patches and {expected.frames} whole frames, "
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


def size_text(number: int) -> str:
    """Return bytes as `12 MB` or `3.4 GB`."""
    return f"{number / 1e9:.1f} GB" if number >= 1e9 else f"{number / 1e6:.0f} MB"


def _bytes_per_pixel(record: FrameRecord, options: PrepareOptions) -> int:
    has = {*record.buffers, *record.derived, "history"}
    names = [name for name in dict.fromkeys((*BUFFERS, *options.buffers)) if name in has]
    return sum(buffer(name).channels * (2 if buffer(name).half else 4) for name in names)
