"""`trainer inspect`: say what a file, a data set or shards contain."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from data.dropped import Dropped

HELP = "say what a file, a data set or shards contain"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "path",
        metavar="PATH",
        help="an EXR file, a data set, the root of a layout, shards, sample:bmfr, or the URL of shards",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument(
        "--html",
        metavar="FILE",
        type=Path,
        help="write a page with pictures of a data set, and what to look at",
    )
    parser.add_argument("--processes", type=int, metavar="N", help="for --html (default: cores, at most 4)")
    parser.add_argument("--force", action="store_true", help="replace the file of --html")


def run(args: argparse.Namespace) -> int:
    """Print what was found, or write it as a page; returns 0, or 1 where files do not match their checksums.

    Raises:
        ValueError: The path is nothing that can be inspected, or damaged; or the page is there already.
        OSError: It does not exist or cannot be read, or the page cannot be written.
    """
    from data.inspection import inspect_path, inspect_url
    from data.remote import shown, url_of

    url = url_of(args.path)
    if url is not None and args.html is not None:
        raise ValueError(f"--html shows frames on this machine, and {shown(url)} can hold shards only")
    path = _resolve(args.path)
    if args.html is not None:
        return _write_page(path, args)
    for name in ("processes", "force"):
        if getattr(args, name):
            raise ValueError(f"--{name} is for --html FILE, which is not given")
    found = inspect_path(path) if url is None else inspect_url(url)
    if args.json:
        print(json.dumps(found, indent=1, ensure_ascii=False))
    else:
        from rich.console import Console

        _PRINTERS[found["kind"]](found, Console(width=None if sys.stdout.isatty() else 120))
    return 1 if found.get("problems") else 0


def _write_page(path: Path, args: argparse.Namespace) -> int:
    from data.ingestion import default_processes
    from data.manifest import MANIFEST
    from trainer.commands.ingest import showing
    from trainer.reports.data_report import write_report

    if args.processes is not None and args.processes < 1:
        raise ValueError(f"--processes is {args.processes}, expected at least 1")
    if path.name == MANIFEST and path.is_file():
        path = path.parent
    _require_data_set(path)
    with showing("frames") as progress:
        found = write_report(
            path,
            args.html,
            force=args.force,
            processes=args.processes or default_processes(),
            progress=progress,
        )
    if args.json:
        print(json.dumps([vars(f) for f in found], indent=1, ensure_ascii=False))
    else:
        for f in found:
            print(f"{f.level}: {f.text}" + (f" ({', '.join(f.scenes)})" if f.scenes else ""))
    size = args.html.stat().st_size / 1e6
    print(f"{args.html}: {size:.1f} MB; open it in a browser", file=sys.stderr if args.json else sys.stdout)
    return 1 if any(f.damaged for f in found) else 0


def _require_data_set(path: Path) -> None:
    """Refuse what is no data set, saying what to do with it."""
    from data.inspection import INDEX
    from data.layouts import likeliest
    from data.manifest import MANIFEST

    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if (path / MANIFEST).is_file():
        return
    wanted = "--html shows a data set, that is a folder made by `trainer ingest` or `trainer render`"
    if (path / INDEX).is_file():
        raise ValueError(f"{path} holds shards; {wanted}: name the one that they were prepared from")
    layout = likeliest(path)
    if layout is not None:
        raise ValueError(f"{path} has the layout {layout}; {wanted}: ingest it first, with --layout {layout}")
    raise ValueError(f"{path} is no data set (it has no {MANIFEST}); {wanted}")


def _resolve(name: str) -> Path:
    if not name.startswith("sample:"):
        return Path(name)
    from data.sample import SAMPLES

    known = name.removeprefix("sample:")
    if known not in SAMPLES:
        raise ValueError(f"there is no sample {known!r}; there is {', '.join(SAMPLES)}")
    return SAMPLES[known]


def _line(console: Console, text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def _print_frame(found: Mapping[str, Any], console: Console, title: str = "") -> None:
    _line(console, title or str(found["path"]))
    _line(
        console,
        f"{found['width']}x{found['height']}, scene {found['scene']}, frame {found['frame']}, "
        f"spp {_known(found['spp'])}, exposure {_known(found['exposure'])}, "
        f"camera {'yes' if found['camera'] else 'unknown'}"
        + (", irradiance accumulated" if found["accumulated"] else ""),
    )
    console.print(_buffer_table(found["buffers"]))
    if found["samples"]:
        apart = found["samples"]
        _line(console, f"samples: {apart['count']} per pixel, each with {', '.join(apart['quantities'])}")
        if lost := _dropped(apart):
            _line(console, f"samples: {lost.text()}")
    for name, rule in found["derived"].items():
        _line(console, f"derived: {name} = {rule}")
    if found["ignored"]:
        _line(console, f"channels without a meaning here: {', '.join(found['ignored'])}")


def _buffer_table(buffers: Mapping[str, Any]) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("buffer", no_wrap=True)
    table.add_column("from", overflow="fold", min_width=4)
    table.add_column("type", no_wrap=True)
    for title in ("min", "median", "max", "NaN/Inf %", "no hit %"):
        table.add_column(title, justify="right", no_wrap=True)
    for name, b in buffers.items():
        source = _joined(b.get("channels", [])) or "x".join(map(str, b.get("shape", [])))
        source = source.removeprefix(f"{name}.")
        numbers = (b.get("min"), b.get("median"), b.get("max"), b["non_finite_percent"], b["no_hit_percent"])
        table.add_row(name, source, b["type"], *("" if n is None else f"{n:.3g}" for n in numbers))
    return table


def _joined(channels: list[str]) -> str:
    """Shorten color.R, color.G, color.B to color.RGB."""
    layers = {c.rpartition(".")[0] for c in channels}
    if len(channels) > 1 and len(layers) == 1 and "" not in layers:
        return f"{layers.pop()}.{''.join(c.rpartition('.')[2] for c in channels)}"
    return ", ".join(channels)


def _print_set(found: Mapping[str, Any], console: Console) -> None:
    from rich import box
    from rich.table import Table

    from trainer.commands.ingest import frames_text, repairs

    _line(console, f"{found['path']}: data set {found['name']!r}, {found['frames']} frames")
    _line(console, f"layout {found['layout']}, depth {found['depth']}, hash {found['hash']}")
    _line(console, "; ".join(f"{split}: {', '.join(s) or 'none'}" for split, s in found["splits"].items()))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for title in ("scene", "split", "frames", "size", "MB", "exposure", "spp", "licence"):
        table.add_column(title, overflow="fold")
    for name, s in found["scenes"].items():
        low, high = s["exposure"]
        table.add_row(
            name,
            s["split"],
            frames_text(s["frames"], s["sequence"]),
            f"{s['width']}x{s['height']}",
            f"{s['bytes'] / 1e6:.2f}",
            f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}",
            _known(s["spp"]),
            s["license"] or "not stated",
        )
    console.print(table)
    for name, s in found["scenes"].items():
        if s["credit"]:
            _line(console, f"{name}: {s['credit']}; {s['provenance']}")
        for line in repairs(s["repaired"], _dropped(s)):
            _line(console, f"{name}: {line}")
    if found["notes"]:
        _line(console, found["notes"])
    _print_problems(found, console)
    for name, frame in found["first_frames"].items():
        _print_frame(frame, console, f"\n{name}, first frame")


def _dropped(found: Mapping[str, Any]) -> Dropped | None:
    from data.dropped import Dropped

    lost = Dropped(**found["dropped"])
    return lost if lost.samples else None


def _print_layout(found: Mapping[str, Any], console: Console) -> None:
    _line(
        console,
        f"{found['path']}: layout {found['layout']}, {len(found['scenes'])} scenes, "
        f"{found['frames']} frames, depth {found['depth']}",
    )
    for name, s in found["scenes"].items():
        limits = ", ".join(f"{k} {v:g}" for k, v in s["thresholds"].items()) or "automatic limits"
        kind = "sequence" if s["sequence"] else "views"
        _line(console, f"{name}: {s['frames']} frames, {kind}, {limits}")
        _print_frame(found["first_frames"][name], console, "first frame")


def _print_shards(found: Mapping[str, Any], console: Console) -> None:
    _line(console, f"{found['path']}: shards of the data set {found['manifest_hash'][:12]}")
    _line(console, "options: " + ", ".join(f"{k} {v}" for k, v in found["options"].items()))
    for name, split in found["splits"].items():
        kind = "samples" if split["frames"] == 1 else f"clips of {split['frames']} frames"
        _line(
            console,
            f"{name}: {split['samples']} {kind} in {split['shards']} shards, {split['bytes'] / 1e6:.1f} MB",
        )
        if split["buffers"]:
            console.print(_buffer_table(split["buffers"]))
    _print_problems(found, console)


def _print_problems(found: Mapping[str, Any], console: Console) -> None:
    for problem in found["problems"]:
        _line(console, f"problem: {problem}")
    if not found["problems"]:
        _line(console, f"{found.get('checked', 'checksums')}: all files match")


def _known(value: Any) -> str:
    return "unknown" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


_PRINTERS = {"file": _print_frame, "data set": _print_set, "layout": _print_layout, "shards": _print_shards}
