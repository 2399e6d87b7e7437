"""`trainer denoise`: denoise EXR files, sequences and data sets."""

from __future__ import annotations

import argparse
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

    from trainer.clips import Item
    from trainer.denoising import Result

HELP = "denoise EXR files and sequences"
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 2**10, "mi": 2**20, "gi": 2**30}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "paths",
        nargs="+",
        metavar="FILE_OR_DIR",
        help="EXR files, folders of them, ingested data sets, folders of a known layout, or sample:NAME",
    )
    parser.add_argument(
        "--model",
        required=True,
        metavar="MODEL",
        help="checkpoint or run folder, MLflow URI (models:/NAME/VERSION, models:/NAME@ALIAS, "
        "runs:/ID/PATH), exported .onnx or .ts file, published checkpoint, or class name of a denoiser "
        "without parameters",
    )
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--png", action="store_true", help="also write tone-mapped pictures, and comparisons with a reference"
    )
    parser.add_argument(
        "--attention",
        type=_pixel,
        metavar="X,Y",
        help="with --png: also picture where a network with attention (AFGSA) looks for the pixel in "
        "column X and row Y, counted from 0 at the upper left",
    )
    parser.add_argument(
        "--split", choices=("train", "validation", "test"), help="only these scenes of a data set"
    )
    parser.add_argument(
        "--exposure",
        type=_exposure,
        metavar="X|auto",
        help="factor that brings radiance to a displayable level (default: the frame's own, else measured)",
    )
    parser.add_argument(
        "--memory",
        type=_bytes,
        default=_bytes("2GB"),
        metavar="SIZE",
        help="memory that the model may take, such as 2GB or 500MB; larger images are tiled (default: 2GB)",
    )
    parser.add_argument(
        "--device", default="cpu", metavar="DEVICE", help="cpu, cuda, cuda:1 … (default: cpu)"
    )
    parser.add_argument(
        "--no-accumulate", action="store_true", help="do not accumulate sequences over preceding frames"
    )
    parser.add_argument(
        "--layers",
        action="store_true",
        help="write a folder of pictures of every layer before and after filtering, and its opacity (Layer, "
        "Optimized)",
    )
    parser.add_argument("--force", action="store_true", help="replace results that are already there")


def run(args: argparse.Namespace) -> int:
    """Denoise everything that was named; returns the exit code.

    Raises:
        UsageError: Options do not go together.
        ValueError: An input, option or frame is wrong; frames that were finished before stay.
        OSError: A file cannot be read or written.
    """
    from trainer.configs import UsageError

    if args.attention is not None and not args.png:
        raise UsageError("--attention draws a picture: expected --png with it")
    from trainer.clips import find_clips
    from trainer.denoising import ClipDenoiser, Settings, replaced_pixels
    from trainer.loading import resolve
    from trainer.outputs import make_folder, refuse_existing

    _check_device(args.device)
    clips = find_clips(args.paths, args.split)
    items = [item for clip in clips for item in clip.items]
    wanted = _Wanted(args.output, args.png, args.attention is not None, args.layers)
    outputs = [path for item in items for path in wanted.paths(item).values()]
    _refuse_inputs(items, outputs)
    refuse_existing(outputs, args.force)
    make_folder(args.output)
    loaded = resolve(args.model, args.device)
    number = args.exposure if isinstance(args.exposure, float) else None
    settings = Settings(
        number,
        args.exposure == "auto",
        not args.no_accumulate,
        args.memory,
        args.device,
        args.attention,
        args.layers,
    )
    with _progress(len(items)) as progress:
        for clip in clips:
            denoiser = ClipDenoiser(loaded, clip, settings, progress.say)
            for item in clip.items:
                with _naming(item, progress.say):
                    frame = item.read()
                    if replaced := replaced_pixels(frame):
                        progress.say(f"{item.label}: {replaced}")
                    result = denoiser.step(frame)
                _write(result, wanted.paths(item))
                progress.advance(item)
    print(
        f"{len(items)} frame{'s' * (len(items) != 1)} written to {args.output} ({progress.rate})",
        file=sys.stderr,
    )
    return 0


def _exposure(text: str) -> float | str:
    if text == "auto":
        return text
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a positive number nor 'auto'")
    return value


def _pixel(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+),(\d+)", "".join(text.split()))
    if match is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no pixel; expected its column and row, such as 120,64, counted from 0"
        )
    return int(match[1]), int(match[2])


def _bytes(text: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmg]?i?)b?", text.strip().lower())
    if match is None or match[2] not in _UNITS or not float(match[1]) > 0:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no size; expected a number with a unit, such as 2GB or 500MB"
        )
    return int(float(match[1]) * _UNITS[match[2]])


@dataclass(frozen=True)
class _Wanted:
    """Which results are written, and where."""

    folder: Path
    png: bool
    attention: bool
    layers: bool = False

    def paths(self, item: Item) -> dict[str, Path]:
        """Return the files of a frame by what they show; those of pictures only where they are wanted."""
        suffixes = {"exr": ".exr"}
        if self.png:
            suffixes |= {"denoised": ".png", "comparison": "_comparison.png"}
        if self.attention:
            suffixes["attention"] = "_attention.png"
        if self.layers:
            suffixes["layers"] = "_layers"
        return {kind: self.folder / f"{item.name}{suffix}" for kind, suffix in suffixes.items()}


def _refuse_inputs(items: list[Item], outputs: list[Path]) -> None:
    sources = {item.source.resolve() for item in items if item.source is not None}
    for path in outputs:
        if path.resolve() in sources:
            raise ValueError(f"{path} is an input; choose another --output")


def _check_device(device: str) -> None:
    import torch

    try:
        wanted = torch.device(device)
        backend = torch.get_device_module(wanted.type)
    except RuntimeError as error:
        raise ValueError(f"--device {device}: expected cpu, cuda or cuda:NUMBER") from error
    number = backend.device_count() if backend.is_available() else 0
    if number == 0:
        name = {"cuda": "CUDA"}.get(wanted.type, wanted.type)
        raise ValueError(
            f"--device {device}: no {name} device, or a build of PyTorch without {name}; use --device cpu"
        )
    if (wanted.index or 0) >= number:
        last = f"{wanted.type}:{number - 1}"
        raise ValueError(f"--device {device}: there is no such device, the last one here is {last}")


@contextmanager
def _naming(item: Item, say: Callable[[str], None]) -> Iterator[None]:
    """Name the frame in every error, and show warnings of readers as remarks."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            yield
        except (ValueError, OSError) as error:
            text = str(error)
            # Not the error's own class: those of subclasses, such as JSONDecodeError, take other arguments.
            kind = OSError if isinstance(error, OSError) else ValueError
            raise kind(text if item.label in text else f"{item.label}: {text}") from error
    for warning in caught:
        say(str(warning.message))


def _write(result: Result, paths: dict[str, Path]) -> None:
    from data.exr import write_frame
    from trainer.outputs import replacing

    exr = paths["exr"]
    exr.parent.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(result) if "denoised" in paths else {}
    for kind, image in pictures.items():
        with replacing(paths[kind]) as temporary:
            image.save(temporary)
    if result.layers is not None:
        paths["layers"].mkdir(exist_ok=True)
        for name, image in result.layers.pictures(result.exposure).items():
            with replacing(paths["layers"] / f"{name}.png") as temporary:
                image.save(temporary)
    write_frame(result.frame, exr)  # last: a frame with its EXR is finished


def _pictures(result: Result) -> dict[str, Picture]:
    from trainer.reports.attention import attention_picture
    from trainer.reports.pictures import comparison, tone_map

    color, exposure, label = result.frame.buffers["color"], result.exposure, result.frame.label
    pictures = {"denoised": tone_map(color, exposure)}
    if result.reference is not None:
        title = f"{label}, exposure {exposure:.4g}"
        pictures["comparison"] = comparison(
            result.noisy, result.accumulated, color, result.reference, exposure, title
        )
    if result.attention is not None:
        pictures["attention"] = attention_picture(color, exposure, result.attention, label)
    return pictures


class _Progress:
    """A bar with rate and remaining time on a terminal, plain lines otherwise."""

    def __init__(self, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self.total, self.done, self.start = total, 0, time.monotonic()
        self.said: set[str] = set()
        console = Console(stderr=True)
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
            )
            self.bar = Progress(*columns, console=console)
            self.task = self.bar.add_task("denoising", total=total, rate="")

    @property
    def rate(self) -> str:
        """Frames per second since the start."""
        return f"{self.done / max(time.monotonic() - self.start, 1e-9):.2f} frames/s"

    def say(self, text: str) -> None:
        """Show a remark, once."""
        if text in self.said:
            return
        self.said.add(text)
        if self.bar is not None:
            self.bar.console.print(f"note: {text}", highlight=False, markup=False, soft_wrap=True)
        else:
            print(f"note: {text}", file=sys.stderr)

    def advance(self, item: Item) -> None:
        """Count a frame."""
        self.done += 1
        if self.bar is not None:
            self.bar.update(self.task, advance=1, description=item.name, rate=self.rate)
        else:
            print(f"{self.done}/{self.total} {item.name} ({self.rate})", file=sys.stderr)


@contextmanager
def _progress(total: int) -> Iterator[_Progress]:
    progress = _Progress(total)
    if progress.bar is None:
        yield progress
        return
    with progress.bar:
        yield progress
