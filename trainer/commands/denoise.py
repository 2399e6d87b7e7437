"""`trainer denoise`: denoise EXR files, sequences and data sets."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainer.clips import Item
    from trainer.inputs import Say

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
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of a method that is named by its class, such as window=5 or features=normal,albedo; "
        "may be repeated (`trainer models NFOR` lists those of NFOR)",
    )
    parser.add_argument(
        "--fill",
        action="append",
        default=[],
        metavar="QUANTITY=VALUE",
        help="constant that stands for a quantity where samples lack it, such as lens=0 or time=0.5, for "
        "models that read the samples of each pixel; may be repeated",
    )
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--png", action="store_true", help="also write tone-mapped pictures, and comparisons with a reference"
    )
    parser.add_argument(
        "--aux",
        action="store_true",
        help="also write what the method made on its way (NFOR, RDFC: estimated errors, selection, filtered "
        "features; Layer, Optimized: layers; WSKP: those of --weights) to NAME_aux.exr, and with --png a "
        "picture of it",
    )
    parser.add_argument(
        "--layers",
        action="store_true",
        help="also write NAME_layers, a folder of pictures: every layer before and after filtering, its "
        "opacity, the composite, and all on one sheet (Layer, Optimized)",
    )
    parser.add_argument(
        "--weights",
        action="store_true",
        help="also write NAME_weights, a folder of pictures as in figure 8 of WSKP's paper: for every kernel "
        "size the image that it makes alone, its fusion weight (black 0 to pale yellow 1) and its "
        "log-importance (black and white are the values in the file's name), and all on one sheet, "
        "kernels.png (WSKP, MultiResolutionWSKP)",
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
        type=size_in_bytes,
        default=size_in_bytes("2GB"),
        metavar="SIZE",
        help="memory that the model may take, such as 2GB or 500MB; larger images are tiled, and sequences "
        "cut, which changes no result (default: 2GB)",
    )
    parser.add_argument(
        "--device", default="cpu", metavar="DEVICE", help="cpu, cuda, cuda:1 … (default: cpu)"
    )
    parser.add_argument(
        "--no-accumulate", action="store_true", help="do not accumulate sequences over preceding frames"
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
    from trainer.denoising import Settings
    from trainer.inputs import replaced_pixels
    from trainer.kernels import Kernels
    from trainer.loading import resolve
    from trainer.outputs import make_folder, refuse_existing
    from trainer.progress import FrameProgress
    from trainer.results import Wanted, write
    from trainer.samples import fill, return_layers
    from trainer.sequences import denoiser_of
    from trainer.weights import return_weights

    check_device(args.device)
    clips = find_clips(args.paths, args.split)
    items = [item for clip in clips for item in clip.items]
    wanted = Wanted(args.output, args.png, args.attention is not None, args.aux, args.layers, args.weights)
    outputs = [path for item in items for path in wanted.paths(item).values()]
    _refuse_inputs(items, outputs)
    refuse_existing(outputs, args.force)
    make_folder(args.output)
    loaded = resolve(args.model, args.device, options=args.option, aux=args.aux)
    number = args.exposure if isinstance(args.exposure, float) else None
    settings = Settings(
        number, args.exposure == "auto", not args.no_accumulate, args.memory, args.device, args.attention
    )
    fill(loaded.model, args.fill)
    if args.layers:
        return_layers(loaded)
    if args.weights:
        return_weights(loaded)
    kernels = Kernels(loaded.model, args.device)
    with FrameProgress(len(items), kernels.hint) as progress, kernels.announced(progress.say):
        for clip in clips:
            denoiser = denoiser_of(loaded, clip, settings, progress)
            for item in clip.items:
                with _naming(item, progress.say):
                    frame = item.read()
                    if replaced := replaced_pixels(frame):
                        progress.say(f"{item.label}: {replaced}")
                    results = list(denoiser.push(item, frame))
                    if item is clip.items[-1]:
                        results += denoiser.finish()
                for done, result in results:
                    write(result, wanted.paths(done))
                    progress.advance(done.name)
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


def size_in_bytes(text: str) -> int:
    """Return the bytes that a text such as `2GB` means, for options."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmg]?i?)b?", text.strip().lower())
    if match is None or match[2] not in _UNITS or not float(match[1]) > 0:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no size; expected a number with a unit, such as 2GB or 500MB"
        )
    return int(float(match[1]) * _UNITS[match[2]])


def _refuse_inputs(items: list[Item], outputs: list[Path]) -> None:
    sources = {item.source.resolve() for item in items if item.source is not None}
    for path in outputs:
        if path.resolve() in sources:
            raise ValueError(f"{path} is an input; choose another --output")


def check_device(device: str) -> None:
    """Raise a ValueError unless there is such a device."""
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
def _naming(item: Item, say: Say) -> Iterator[None]:
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
