"""`trainer prepare`: cut ingested frames into shards of training patches."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data.shards.index import Index
    from data.shards.options import PrepareOptions
    from data.shards.prepare import Progress

HELP = "cut frames into shards of training patches"


EPILOG = """\
recipes, for what the published methods were trained on; other options override them:
  bmfr    uniform, 80 training and 20 validation patches per 1280x720 frame, accumulated (WSKP); the defaults
  afgsa   importance sampling of 400 candidates per 1280x720 frame, one view in twenty held out for
          validation, not accumulated; color, albedo, normal, depth, reference
  layers  uniform, 56 and 14 patches per 1280x720 frame (training crops cover a frame's area once), not
          accumulated; the same buffers, and samples in half precision, radiance clipped to [0, 65504]
  recurrent  clips of seven consecutive frames of a sequence for networks with a memory (Chaitanya et al.),
          uniform, not accumulated; the buffers of afgsa, no samples. A clip counts as a patch of each of its
          frames: there are about a seventh as many

importance sampling: candidates are thrown over each frame at a distance, then dropped at random, the more the
less noisy colour and normals vary in the patch; AFGSA kept 258 of 400. Frames without normals are judged by
colour alone. Numbers per frame keep their density: a frame of half the area gets half of them.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("source", metavar="DIR", help="ingested or rendered frames, or sample:NAME")
    parser.add_argument(
        "--output",
        required=True,
        metavar="SHARDS",
        help="folder to make, or s3://BUCKET/SHARDS, or http(s)://HOST/SHARDS of a server that takes PUT",
    )
    parser.add_argument(
        "--recipe", choices=("bmfr", "afgsa", "layers", "recurrent"), help="see below (default: none)"
    )
    _add_positions(parser)
    _add_contents(parser)
    parser.add_argument(
        "--samples-per-shard",
        type=int,
        metavar="N",
        help="patches, candidates or clips in a shard at most (default 256; recurrent: 36)",
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=os.cpu_count() or 1,
        metavar="N",
        help="scenes done at one time (default: number of cores); the result does not depend on it",
    )
    parser.add_argument("--force", action="store_true", help="replace shards that exist")


def _add_positions(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("which patches")
    group.add_argument("--sampling", choices=("uniform", "importance"), help="positions (default uniform)")
    group.add_argument("--patch-size", type=int, metavar="N", help="pixels (default 128)")
    group.add_argument(
        "--clip-frames",
        dest="frames",
        type=int,
        metavar="N",
        help="consecutive frames of a patch; more than one make clips, which only sequences give (default 1; "
        "recurrent: 7)",
    )
    group.add_argument(
        "--train-patches", type=int, metavar="N", help="uniform: per 1280x720 frame (default 80)"
    )
    group.add_argument(
        "--validation-patches",
        type=int,
        metavar="N",
        help="uniform: per 1280x720 frame (default 20); importance, where validation patches come from the "
        "training frames: candidates in proportion to --train-patches",
    )
    group.add_argument(
        "--candidates", type=int, metavar="N", help="importance: per 1280x720 frame (default 400)"
    )
    group.add_argument(
        "--importance-floor",
        type=float,
        metavar="X",
        help="importance: smallest squared mean that the variance of colour is divided by (default 1e-4; "
        "1e-2 gives dark regions less weight)",
    )
    group.add_argument(
        "--validation-share",
        type=float,
        metavar="X",
        help="share of the views that is held out for validation, where the frames have no scenes for it "
        "(default 0: validation patches come from the training frames)",
    )
    group.add_argument(
        "--spp", type=int, nargs="+", metavar="N", help="only frames with these samples per pixel"
    )
    group.add_argument(
        "--wskp-legacy-crops",
        action="store_true",
        default=None,
        help="crop as the authors' script of WSKP: 77 crops, zero padding, left and top part of the frame",
    )
    group.add_argument("--seed", type=int, metavar="N", help="seed of the patch positions (default 1)")


def _add_contents(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what is kept of them")
    group.add_argument(
        "--buffers", metavar="A,B", help="buffers to keep beside the usual ones, such as motion"
    )
    group.add_argument(
        "--only", metavar="A,B", help="buffers to keep instead of the usual ones, where frames have them"
    )
    group.add_argument(
        "--samples",
        choices=("auto", "half", "none"),
        help="samples that frames keep apart: as precise as they are, in half precision, or left out "
        "(default auto)",
    )
    group.add_argument(
        "--accumulate",
        action=argparse.BooleanOptionalAction,
        help="accumulate sequences over preceding frames (default: yes)",
    )


def check(args: argparse.Namespace) -> None:
    """Check the options alone; nothing is read or cut.

    Raises:
        UsageError: Some do not fit.
    """
    from trainer.configs import UsageError

    try:
        if args.processes < 1:
            raise ValueError(f"--processes is {args.processes}; expected at least 1")
        _options(args)
    except ValueError as error:
        raise UsageError(str(error)) from None


def run(args: argparse.Namespace) -> int:
    """Prepare, and print what was made."""
    from data.frames import FrameSet
    from data.remote import shown, url_of
    from data.root import resolve_root
    from data.shards.division import left_out
    from data.shards.prepare import prepare

    url = url_of(args.output)
    root = resolve_root(args.source)
    if root.kind != "frames":
        raise ValueError(f"{args.source} holds shards already; name a folder made by `trainer ingest`")
    if args.processes < 1:
        raise ValueError(f"--processes is {args.processes}; expected at least 1")
    options = _options(args)
    remarks = left_out(FrameSet(root.path), options)
    if url is not None:
        _print(shown(url), _publish(root.path, url, options, args), options, remarks)
        return 0
    with _progress(f"preparing {root.path.name}", _unit(options)) as progress:
        index = prepare(
            root.path,
            Path(args.output),
            options,
            processes=args.processes,
            force=args.force,
            progress=progress,
        )
    _print(args.output, index, options, remarks)
    return 0


def _publish(root: Path, url: str, options: PrepareOptions, args: argparse.Namespace) -> Index:
    """Cut and send, with a bar for each."""
    from data.remote import shown
    from data.shards.publish import publish

    with ExitStack() as bars:

        def sending() -> Progress:
            bars.close()  # the bar of cutting
            return bars.enter_context(_progress(f"sending to {shown(url)}", "MB"))

        cutting = bars.enter_context(_progress(f"preparing {root.name}", _unit(options)))
        return publish(
            root,
            url,
            options,
            processes=args.processes,
            force=args.force,
            cutting=cutting,
            sending=sending,
        )


def _options(args: argparse.Namespace) -> PrepareOptions:
    from data.shards.options import PrepareOptions, recipe_options

    explicit: dict[str, Any] = {f.name: getattr(args, f.name) for f in fields(PrepareOptions)}
    for name in ("buffers", "only"):
        if explicit[name] is not None:
            explicit[name] = tuple(word for word in explicit[name].split(",") if word)
    explicit["spp"] = None if args.spp is None else tuple(args.spp)
    return recipe_options(explicit.pop("recipe"), explicit)


def _unit(options: PrepareOptions) -> str:
    return "candidates" if options.sampling == "importance" else "samples"


def _print(output: str, index: Index, options: PrepareOptions, remarks: Sequence[str]) -> None:
    size = sum(shard.bytes for shard in index.shards) / 1e6
    print(f"{output}: {len(index.shards)} shards, {size:.1f} MB")
    for split in ("train", "validation", "test"):
        cut = "patches" if index.frames == 1 else f"clips of {index.frames} frames"
        kind = "frames" if split == "test" else cut
        print(
            f"  {split:<10} {index.count(split):>6} {kind} of {', '.join(index.scenes(split)) or 'no scene'}"
        )
    if index.shards and index.shards[0].per_sample is not None:
        count, channels = index.shards[0].per_sample
        print(f"  {count} samples of {len(channels)} channels per pixel are kept apart")
    if options.sampling == "importance":
        judged = index.pruned + index.skipped + index.count("train") + index.count("validation")
        print(f"  {index.pruned} of {judged} candidates were dropped, where colour and normals vary little")
        bare = _without_normal(index)
        if bare:
            print(f"  {bare} frames have no normal, so colour alone chose their patches")
    if index.skipped:
        cut = "patches" if index.frames == 1 else "clips"
        print(f"  {index.skipped} {cut} with a black reference were left out")
    for remark in remarks:
        print(f"  {remark}")


def _without_normal(index: Index) -> int:
    scenes = {shard.scene for split in ("train", "validation") for shard in index.of(split)}
    records = [frame for scene in scenes for frame in index.manifest["scenes"][scene]["frames"]]
    return sum("normal" not in {*record["buffers"], *record["derived"]} for record in records)


@contextmanager
def _progress(title: str, unit: str) -> Iterator[Progress]:
    """Yield a bar on a terminal, and something that prints lines elsewhere."""
    from data.progress import LineProgress, Rate

    if not sys.stderr.isatty():
        yield LineProgress(title, unit=unit)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, text="")
        rate = Rate(unit)
        yield lambda done, total: bar.update(task, completed=done, total=total, text=rate.text(done, total))
