"""Clips: the same window of consecutive frames. Which frames of a scene they are cut from, and how many begin
at each.

A clip begins at any frame that enough others follow: in a scene whose manifest calls it a sequence, without a
gap and in one size. A scene has as many clips as keep the number of patches per pixel, where a clip counts as
a patch of each of its frames; each possible beginning has the same number of them or one more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import accumulate, pairwise

from data.frames import FrameSet
from data.manifest import FrameRecord
from data.patches import REFERENCE_AREA, generator_of

NAMED = 8
"""Scenes that an error names, at most."""


def clips_of(records: Sequence[FrameRecord], length: int) -> dict[int, tuple[int, ...]]:
    """Return all clips that frames of a sequence allow: the first frame's index → the indices of all.

    Args:
        records: Frames in ascending order.
        length: Frames of a clip.
    """
    return {
        part[start].index: tuple(record.index for record in part[start : start + length])
        for part in _parts(records)
        for start in range(len(part) - length + 1)
    }


def clip_counts(
    records: Sequence[FrameRecord], length: int, per_reference: int, seed: tuple[int | str, ...]
) -> dict[int, int]:
    """Return how many clips begin at each frame of a sequence that can begin one.

    Args:
        records: Frames in ascending order, of which at least one begins a clip.
        length: Frames of a clip.
        per_reference: Patches per 1280x720 frame.
        seed: Of the choice which frames begin one clip more than others.

    Returns:
        Index → number. In all floor(patches / length), where `patches` is what the frames that clips are cut
        from would give, and at least 1 unless `per_reference` is 0.
    """
    parts = [part for part in _parts(records) if len(part) >= length]
    areas = accumulate(sum(record.width * record.height for record in part) for part in parts)
    ends = [math.floor(Fraction(per_reference * area, REFERENCE_AREA * length)) for area in areas]
    numbers = [after - before for before, after in pairwise([0, *ends])]
    if ends[-1] == 0 and per_reference > 0:
        numbers[0] = 1
    generator = generator_of(seed)
    counts: dict[int, int] = {}
    for part, number in zip(parts, numbers, strict=True):
        starts = part[: len(part) - length + 1]
        each, left = divmod(number, len(starts))
        more = set(generator.permutation(len(starts))[:left].tolist())
        counts |= {record.index: each + (place in more) for place, record in enumerate(starts)}
    return counts


def lacking(frames: FrameSet, scenes: Mapping[str, Sequence[FrameRecord]], length: int) -> dict[str, str]:
    """Return the scenes that no clip fits into, and why.

    Args:
        frames: The data set.
        scenes: Scene → its frames in ascending order.
        length: Frames of a clip; of 1 nothing lacks.
    """
    found = {}
    for scene, records in scenes.items():
        if length == 1:
            continue
        if not frames.manifest.scenes[scene].sequence:
            found[scene] = "is no sequence"
        elif (longest := max(map(len, _parts(records)))) < length:
            found[scene] = f"has {longest} in a row"
    return found


def listed(scenes: Mapping[str, str]) -> str:
    """Return scenes with what is said of each, as far as there is room."""
    told = [f"{scene} {why}" for scene, why in list(scenes.items())[:NAMED]]
    more = f" and {len(scenes) - NAMED} more" if len(scenes) > NAMED else ""
    return ", ".join(told) + more


def _parts(records: Sequence[FrameRecord]) -> list[list[FrameRecord]]:
    """Divide frames where one does not follow the one before, or has another size."""
    parts: list[list[FrameRecord]] = []
    for record in records:
        if parts and _follows(parts[-1][-1], record):
            parts[-1].append(record)
        else:
            parts.append([record])
    return parts


def _follows(before: FrameRecord, record: FrameRecord) -> bool:
    same_size = (before.width, before.height) == (record.width, record.height)
    return same_size and record.moment == before.moment + 1
