"""`trainer export`: write a trained denoiser as ONNX or TorchScript."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "write a trained denoiser as ONNX or TorchScript"
FORMATS = {"onnx": ".onnx", "torchscript": ".ts"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "--model",
        required=True,
        metavar="MODEL",
        help="checkpoint or run folder of `trainer fit`, MLflow URI (runs:/ID/PATH), a published checkpoint, "
        "or the class name of a denoiser without parameters",
    )
    parser.add_argument(
        "--format",
        action="append",
        choices=tuple(FORMATS),
        help="format to write; may be given twice (default: onnx)",
    )
    parser.add_argument(
        "--output",
        required=True,
        type=Path,
        metavar="PATH",
        help="file (its suffix must fit: .onnx, .ts) or folder, in which the file gets the model's name",
    )
    parser.add_argument("--force", action="store_true", help="replace files that are already there")


def run(args: argparse.Namespace) -> int:
    """Export and print the measured parity; returns the exit code.

    Raises:
        ValueError: The model cannot be loaded or exported, or an output exists; nothing is left behind.
    """
    formats = list(dict.fromkeys(args.format or ["onnx"]))
    names = targets(args.output, formats, "model")  # refuses what cannot work before anything heavy is loaded
    from rich.console import Console
    from rich.table import Table

    from models.denoiser import Denoiser
    from trainer.export import export
    from trainer.loading import resolve
    from trainer.outputs import refuse_existing

    loaded = resolve(args.model)
    if not isinstance(loaded.model, Denoiser):
        raise ValueError(
            f"--model {args.model} is an exported {loaded.model.description.format} file already; "
            "export from the checkpoint it was made from"
        )
    names = targets(args.output, formats, type(loaded.model).__name__.lower())
    refuse_existing(names.values(), args.force)
    table = Table(title=f"{type(loaded.model).__name__} from {args.model}", title_justify="left")
    for title in ("file", "format", "differs from eager", "checked with"):
        table.add_column(title, overflow="fold")
    for format, path in names.items():
        print(f"exporting {path} …", file=sys.stderr)
        parity = export(loaded.model, path, format, source=loaded.source, force=args.force)  # type: ignore[arg-type]
        table.add_row(str(path), format, f"{parity.error:.1e}", parity.runtime)
    console = Console()
    console.print(table)
    sizes = ", ".join(f"{batch} x {width}x{height}" for batch, height, width in parity.sizes)
    of_samples = ""
    if parity.counts:
        of_samples = f", {', '.join(map(str, parity.counts))} samples per pixel"
    console.print(
        f"Largest relative difference over {sizes} (images x size){of_samples}, with fireflies, with and "
        f"without frame numbers; allowed {parity.limit:g}.",
        highlight=False,
    )
    return 0


def targets(output: Path, formats: list[str], stem: str) -> dict[str, Path]:
    """Return format → file to write.

    Raises:
        ValueError: One file is named for two formats, or with the other format's suffix.
    """
    known = {suffix: format for format, suffix in FORMATS.items()} | {".pt": "torchscript"}
    if output.suffix not in known or output.is_dir():
        return {format: output / f"{stem}{FORMATS[format]}" for format in formats}
    if len(formats) > 1:
        raise ValueError(f"--output {output} is one file for {len(formats)} formats; give a folder")
    if known[output.suffix] != formats[0]:
        raise ValueError(
            f"--output {output}: the suffix belongs to {known[output.suffix]}, but --format is {formats[0]}"
        )
    return {formats[0]: output}
