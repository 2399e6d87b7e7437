"""`trainer prepare`: cut ingested frames into shards of training patches."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from data.shards.prepare import Progress

HELP = "cut frames into shards of training patches"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="DIR", help="ingested frames, or sample:NAME")
    parser.add_argument("--output", required=True, metavar="SHARDS", type=Path, help="folder to make")
    parser.add_argument("--patch-size", type=int, default=128, metavar="N", help="pixels (default 128)")
    parser.add_argument(
        "--train-patches", type=int, default=80, metavar="N", help="per 1280x720 frame (default 80)"
    )
    parser.add_argument(
        "--validation-patches", type=int, default=20, metavar="N", help="per 1280x720 frame (default 20)"
    )
    parser.add_argument(
        "--samples-per-shard", type=int, default=256, metavar="N", help="at most (default 256)"
    )
    parser.add_argument(
        "--buffers", default="", metavar="A,B", help="buffers to keep beside the usual ones, such as motion"
    )
    parser.add_argument(
        "--no-accumulate", action="store_true", help="do not accumulate sequences over preceding frames"
    )
    parser.add_argument(
        "--wskp-legacy-crops",
        action="store_true",
        help="crop as the authors' script of WSKP: 77 crops, zero padding, left and top part of the frame",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the patch positions (default 1)")
    parser.add_argument(
        "--processes",
        type=int,
        default=os.cpu_count() or 1,
        metavar="N",
        help="scenes done at one time (default: number of cores); the result does not depend on it",
    )
    parser.add_argument("--force", action="store_true", help="replace shards that exist")


def run(args: argparse.Namespace) -> int:
    """Prepare, and print what was made."""
    from data.root import resolve_root
    from data.shards.cut import PrepareOptions
    from data.shards.prepare import prepare

    root = resolve_root(args.source)
    if root.kind != "frames":
        raise ValueError(f"{args.source} holds shards already; name a folder made by `trainer ingest`")
    if args.processes < 1:
        raise ValueError(f"--processes is {args.processes}; expected at least 1")
    options = PrepareOptions(
        patch_size=args.patch_size,
        train_patches=args.train_patches,
        validation_patches=args.validation_patches,
        samples_per_shard=args.samples_per_shard,
        accumulate=not args.no_accumulate,
        seed=args.seed,
        wskp_legacy_crops=args.wskp_legacy_crops,
        buffers=tuple(name for name in args.buffers.split(",") if name),
    )
    with _progress(f"preparing {root.path.name}") as progress:
        index = prepare(
            root.path,
            args.output,
            options,
            processes=args.processes,
            force=args.force,
            progress=progress,
        )
    size = sum(shard.bytes for shard in index.shards) / 1e6
    print(f"{args.output}: {len(index.shards)} shards, {size:.1f} MB")
    for split in ("train", "validation", "test"):
        kind = "frames" if split == "test" else "patches"
        print(
            f"  {split:<10} {index.count(split):>6} {kind} of {', '.join(index.scenes(split)) or 'no scene'}"
        )
    if index.skipped:
        print(f"  {index.skipped} patches with a black reference were left out")
    return 0


@contextmanager
def _progress(title: str) -> Iterator[Progress]:
    """Yield a bar on a terminal, and something that prints lines elsewhere."""
    from data.shards.progress import LineProgress, Rate

    if not sys.stderr.isatty():
        yield LineProgress(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, text="")
        rate = Rate()
        yield lambda done, total: bar.update(task, completed=done, total=total, text=rate.text(done, total))
