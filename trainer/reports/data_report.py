"""The data report: looks at every frame of a data set once and writes one static page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from data.duplicates import near_duplicates
from data.frames import FrameSet
from data.manifest import Manifest
from data.parallel import results
from trainer.outputs import refuse_existing, replacing
from trainer.reports.data_page import column_frames, render, shown_frame
from trainer.reports.findings import Finding, findings
from trainer.reports.frame_facts import MAIN, FrameFacts, FrameJob, Pictures, look_at, one_thread

Progress = Callable[[int, int, str], None]

LIMITS = (320, 256, 192, 160, 128)
"""Largest sides of thumbnails, of which the largest that fits the page is taken."""

PAGE = 11e6
"""Bytes that the thumbnails of a page should stay below."""

BYTES_PER_PIXEL = 0.45
"""Bytes of a thumbnail's pixel in a page, measured on noisy frames."""


def write_report(
    root: str | Path,
    target: Path,
    *,
    force: bool = False,
    processes: int = 1,
    progress: Progress | None = None,
) -> list[Finding]:
    """Look at all frames of a data set and write the page, whole or not at all.

    Args:
        root: Folder of the data set.
        target: The HTML file.
        force: Replace a file that is there.
        processes: Number of processes that read frames.
        progress: Called with frames done, frames in all and the label of the last one.

    Returns:
        What needs attention, most urgent first.

    Raises:
        ValueError: The target is there, or the manifest is damaged.
        OSError: The root is no data set, or the page cannot be written.
    """
    if target.is_dir():
        raise ValueError(f"{target} is a folder; --html names a file, such as {target / 'report.html'}")
    refuse_existing([target], force)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target.parent} does not exist; create it or name another --html")
    frames = FrameSet(root)
    facts = examine(frames, processes, progress)
    pairs = near_duplicates([f.print for f in facts], [f.scene for f in facts])
    found = findings(frames.manifest, facts, pairs)
    page = render(frames, facts, pairs, found)
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return found


def examine(frames: FrameSet, processes: int = 1, progress: Progress | None = None) -> list[FrameFacts]:
    """Read every frame once and return what was found, in the order of the manifest.

    Raises:
        OSError: A process was ended from outside.
    """
    jobs = make_jobs(frames)
    facts: dict[tuple[str, int], FrameFacts] = {}
    for job, found in results(look_at, jobs, processes, one_thread):
        facts[job.scene, job.record.index] = found
        if progress is not None:
            progress(len(facts), len(jobs), f"{found.scene}/frame {found.record.index}")
    return [facts[job.scene, job.record.index] for job in jobs]


def make_jobs(frames: FrameSet) -> list[FrameJob]:
    """Return one job per frame, in the order of the manifest, with the pictures that the page will show."""
    manifest = frames.manifest
    limit, whole = _sizes(manifest)
    jobs = []
    for number, (name, scene) in enumerate(manifest.scenes.items()):
        shown, columns = shown_frame(scene), column_frames(scene)
        first, second = [*scene.strands()[0], None][:2] if scene.sequence else (None, None)
        for record in scene.frames:
            pictures: Pictures = "none"
            if record.index == shown.index:
                pictures = "all" if number < whole else "main"
            large = record.index == shown.index and max(record.width, record.height) > limit
            column = large or any(record.index == c.index for c in columns)
            follows = first and second and record is second and second.moment == first.moment + 1
            before = first.file if first and follows else ""
            jobs.append(FrameJob(str(frames.root), name, record, pictures, limit, column, before))
    return jobs


def _sizes(manifest: Manifest) -> tuple[int, int]:
    """Return the side of the thumbnails, and of how many scenes all buffers are shown."""
    pictures = []
    for scene in manifest.scenes.values():
        first = scene.frames[0]
        buffers = len({*first.buffers, *first.derived})
        aspect = min(first.width, first.height) / max(first.width, first.height)
        pictures.append((buffers + len(column_frames(scene)) + 2, aspect, max(first.width, first.height)))

    def size(limit: int, count: int) -> float:
        total = 0.0
        for i, (number, aspect, side) in enumerate(pictures):
            shown = number if i < count else len(MAIN) + 2
            total += shown * min(limit, side) ** 2 * aspect * BYTES_PER_PIXEL
        return total

    for limit in LIMITS:
        if size(limit, len(pictures)) <= PAGE:
            return limit, len(pictures)
    count = next((n for n in range(len(pictures), 0, -1) if size(LIMITS[-1], n) <= PAGE), 1)
    return LIMITS[-1], count
