"""`trainer ingest`: from a published or rendered layout to frames and a manifest."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data.buffers import SAMPLES

if TYPE_CHECKING:
    from data.dropped import Dropped
    from data.ingestion import Progress
    from data.manifest import Manifest

HELP = "read a published or rendered data set into frames and a manifest"

KNOWN = (
    "bmfr (BMFR, WSKP), nbgd, acfm, afgsa, kpcn, tungsten, oidn, sbmc, layerdenoise, blender, mitsuba, "
    "penumbra"
)


_SUBFOLDERS = 16
"""Subfolders that are looked at where the root itself resembles nothing."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "root", type=Path, metavar="ROOT", help="folder of the source (sbmc: or a .txt list of tiles)"
    )
    parser.add_argument(
        "--layout",
        default="auto",
        help=f"how the source is arranged: {KNOWN}; default: the one that it resembles most",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--test", nargs="+", default=[], metavar="SCENE", help="scenes held out for test (default: the last)"
    )
    parser.add_argument(
        "--validation", nargs="+", default=[], metavar="SCENE", help="scenes held out for validation"
    )
    parser.add_argument(
        "--buffers", nargs="+", metavar="BUFFER", help="store only these buffers (default: all of the source)"
    )
    parser.add_argument(
        "--exposure",
        default="layout",
        metavar="layout|auto|NUMBER",
        help="exposure of the frames: what the layout says (bmfr: 1, penumbra: its sidecar; default), "
        "from each frame's luminance, or a number",
    )
    parser.add_argument("--processes", type=int, metavar="N", help="processes (default: cores, at most 4)")
    parser.add_argument("--force", action="store_true", help="replace what is in DIR")


def run(args: argparse.Namespace) -> int:
    """Ingest and report; returns the exit code.

    Raises:
        ValueError: The source or an option does not fit, or something is already there.
        OSError: A file cannot be read or written.
    """
    from data.ingestion import IngestOptions, default_processes, ingest

    if args.processes is not None and args.processes < 1:
        raise ValueError(f"--processes is {args.processes}, expected at least 1")
    options = IngestOptions(
        test=tuple(args.test),
        validation=tuple(args.validation),
        buffers=None if args.buffers is None else tuple(args.buffers),
        exposure=args.exposure,
        force=args.force,
        processes=args.processes or default_processes(),
    )
    name = args.layout if args.layout != "auto" else _resembled(args.root)
    with showing("frames") as progress:
        manifest = ingest(name, args.root, args.output, options, progress)
    report(manifest, args.output)
    return 0


def _resembled(root: Path) -> str:
    """Return the layout that a folder resembles most, and say so.

    Raises:
        ValueError: It resembles none.
        OSError: There is no such folder.
    """
    from data.layouts import LAYOUTS, likenesses
    from data.layouts.scene import require_folder

    if not root.is_file():
        require_folder(root)
    scores = likenesses(root)
    if not scores:
        below = "" if root.is_file() else _resembled_below(root)
        raise ValueError(
            f"{root} resembles none of the layouts {', '.join(LAYOUTS)}; "
            + (f"in it, {below}: name one of these" if below else "name one with --layout")
        )
    name, *others = scores
    print(f"layout {name}" + (f" (less likely: {', '.join(others)})" if others else ""))
    return name


def _resembled_below(root: Path) -> str:
    """Return which of the first subfolders resemble a layout, for a root that holds several data sets."""
    from data.layouts import likeliest
    from data.layouts.scene import subfolders

    found = {folder.name: likeliest(folder) for folder in subfolders(root)[:_SUBFOLDERS]}
    return ", ".join(f"{name}/ is {layout}" for name, layout in found.items() if layout)


def report(manifest: Manifest, output: Path) -> None:
    """Print scenes, splits, and what was derived or repaired."""
    from rich.console import Console

    from data.dropped import total

    console = Console()
    console.print(scene_table(manifest))
    stored = dict.fromkeys(b for s in manifest.scenes.values() for f in s.frames for b in f.buffers)
    apart = dict.fromkeys(n for s in manifest.scenes.values() for f in s.frames for n in f.samples)
    console.print(f"stored: {', '.join(stored)}", highlight=False, soft_wrap=True)
    if apart:
        console.print(f"stored per sample: {', '.join(apart)}", highlight=False, soft_wrap=True)
    repaired: Counter[str] = Counter()
    derived: dict[str, str] = {}
    frames = [frame for scene in manifest.scenes.values() for frame in scene.frames]
    dropped = total(told for frame in frames if (told := frame.remarks.get("dropped")))
    for scene in manifest.scenes.values():
        for frame in scene.frames:
            repaired.update(frame.repaired)
            derived |= frame.derived
    for name, rule in derived.items():
        console.print(f"derived on reading: {name} = {rule}", highlight=False, soft_wrap=True)
    for line in remarks(manifest):
        console.print(line, highlight=False, soft_wrap=True)
    for line in repairs(repaired, dropped):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(
        f"{output}: {manifest.frame_count} frames; next: trainer prepare {output} --output SHARDS",
        highlight=False,
        soft_wrap=True,
    )


def repairs(repaired: Mapping[str, int], dropped: Dropped | None) -> list[str]:
    """Return what was not finite, a sentence for each buffer.

    Args:
        repaired: Buffer → number of pixels; `samples` → number of infinite distances.
        dropped: Samples that do not count.
    """
    lines = [
        f"repaired: {count} infinite distances of samples are those of rays that left the scene"
        if name == SAMPLES
        else f"repaired: {count} pixels of {name} were NaN or Inf"
        for name, count in repaired.items()
    ]
    return lines if dropped is None else [*lines, f"samples: {dropped.text()}"]


def remarks(manifest: Manifest) -> list[str]:
    """Return what the layout did to buffers or took for granted, a sentence for each, over all frames."""
    said: dict[str, str] = {}
    clipped: Counter[str] = Counter()
    for frame in (f for scene in manifest.scenes.values() for f in scene.frames):
        told = frame.remarks
        said |= {f"derived {n}": f"derived and stored: {n} = {rule}" for n, rule in _pairs(told, "derived")}
        said |= {f"decoded {n}": f"decoded: {n}, {how}" for n, how in _pairs(told, "decoded")}
        said |= {f"assumed {n}": f"assumed: {n} {what}" for n, what in _pairs(told, "assumed")}
        for name in told.get("normalised", ()):
            said[f"normalised {name}"] = f"normalised by the source, no scene units: {name}"
        clipped.update(told.get("clipped", {}))
    lines = [f"clipped: {count} values of {name} were out of range" for name, count in clipped.items()]
    return [*said.values(), *lines]


def _pairs(told: Mapping[str, Any], key: str) -> list[tuple[str, Any]]:
    values = told.get(key, {})
    return list(values.items()) if isinstance(values, dict) else [(name, "") for name in values]


def scene_table(manifest: Manifest) -> Any:
    """Return a table with a row per scene: split, frames, size, exposure, samples per pixel."""
    from rich.table import Table

    table = Table(title=f"{manifest.name} (depth: {manifest.depth})", title_justify="left")
    for title in ("scene", "split", "frames", "size", "exposure", "spp"):
        table.add_column(title, overflow="fold")
    for name, scene in manifest.scenes.items():
        exposures = [f.exposure for f in scene.frames]
        low, high = min(exposures), max(exposures)
        first = scene.frames[0]
        table.add_row(
            name,
            manifest.split_of(name),
            frames_text(len(scene.frames), scene.sequence),
            f"{first.width}x{first.height}",
            f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}",
            "?" if first.spp is None else str(first.spp),
        )
    return table


def frames_text(count: int, sequence: bool) -> str:
    """Return the number of a scene's frames: 8, 1 view, 2 views."""
    return str(count) if sequence else f"{count} view{'s' if count > 1 else ''}"


@contextmanager
def showing(what: str) -> Iterator[Progress]:
    """Yield a callback that shows progress: a bar on a terminal, otherwise a line every tenth of the way."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(what)
        return
    rate = TextColumn("{task.fields[rate]}")
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.description}"), console=console) as bar:
        task = bar.add_task("", total=None, rate="")

        def update(done: int, total: int, label: str) -> None:
            speed = bar.tasks[0].speed
            rate = "" if speed is None else f"{speed:.1f}/s"
            bar.update(task, completed=done, total=total, description=label, rate=rate)

        yield update


def _lines(what: str) -> Progress:
    import sys
    import time

    start = time.monotonic()

    def update(done: int, total: int, label: str) -> None:
        if done == total or done * 10 // total > (done - 1) * 10 // total:
            elapsed = max(time.monotonic() - start, 1e-9)
            left = elapsed / done * (total - done)
            print(
                f"{what}: {done} of {total}, {done / elapsed:.1f}/s, {left:.0f} s left ({label})",
                file=sys.stderr,
            )

    return update
