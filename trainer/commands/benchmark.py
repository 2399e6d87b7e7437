"""`trainer benchmark`: time and peak memory of inference and training, and comparisons of two."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainer.commands.denoise import size_in_bytes
from trainer.configs import UsageError
from trainer.options import AddModel, AddOption

if TYPE_CHECKING:
    from trainer.benchmarking.cases import Case, Method
    from trainer.benchmarking.session import Session

HELP = "measure time and memory of denoisers, or compare two"
INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "--model",
        dest="models",
        action=AddModel,
        required=True,
        metavar="MODEL",
        help="checkpoint or run folder, MLflow URI, exported .onnx or .ts file, published checkpoint, or a "
        "class name (NFOR; of a class with weights, such as WSKP, random ones are measured); may be repeated",
    )
    parser.add_argument(
        "--option",
        dest="models",
        action=AddOption,
        metavar="KEY=VALUE",
        help="option of the --model before it, where that is named by its class, such as window=5",
    )
    several: dict[str, Any] = {"nargs": "+", "action": "extend"}
    parser.add_argument(
        "--kind", choices=("inference", "training"), **several, help="what a call is (default: inference)"
    )
    parser.add_argument(
        "--size",
        type=_size,
        metavar="WxH",
        **several,
        help="sizes of the images (default: 1280x720, for training 128x128)",
    )
    parser.add_argument(
        "--batch",
        type=_batches,
        metavar="N[,N]",
        **several,
        help="images at once (default: 1, for training 8)",
    )
    parser.add_argument(
        "--precision",
        choices=("float32", "bfloat16", "float16"),
        **several,
        help="precision of the arithmetic, below float32 by autocast (default: float32)",
    )
    parser.add_argument("--device", metavar="DEVICE", **several, help="cpu, cuda, cuda:1 … (default: cpu)")
    parser.add_argument(
        "--mode",
        choices=("eager", "compiled", "onnx", "torchscript"),
        **several,
        help="how it runs: as it is, with torch.compile, or exported for ONNX Runtime or TorchScript "
        "(default: eager; exported files run in their own mode)",
    )
    _add_effort(parser)
    _add_comparison(parser)
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder for benchmark.json and plots")
    parser.add_argument("--force", action="store_true", help="replace results that are already there")
    parser.add_argument(
        "--strict", action="store_true", help="exit with 1 if any case failed (default: only if all failed)"
    )


def _add_effort(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--repeat",
        type=_positive,
        metavar="N",
        help="calls that are measured (default: 15); of comparisons, rounds of each pair of processes (4)",
    )
    parser.add_argument(
        "--warmup", type=_positive, default=2, metavar="N", help="calls before them (default: 2)"
    )
    parser.add_argument(
        "--seconds",
        type=_seconds,
        metavar="S",
        help="stop measuring a case after so many seconds, yet not before three calls (default: 20); of a "
        "comparison, after one round of each pair of processes (60)",
    )
    parser.add_argument(
        "--spp", type=_positive, default=8, metavar="N", help="samples per pixel, where they are read (8)"
    )
    parser.add_argument(
        "--memory",
        type=size_in_bytes,
        default=size_in_bytes("2GiB"),
        metavar="SIZE",
        help="memory that a call may take before the image is cut into tiles (default: 2GiB)",
    )


def _add_comparison(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pair",
        action="store_true",
        help="compare two models, which compute in turns: the ratio of their times and whether it is "
        "significant",
    )
    parser.add_argument(
        "--revisions",
        nargs=2,
        metavar=("A", "B"),
        help="compare one model in two revisions of this checkout in the same way; . stands for the files "
        "as they are now",
    )
    parser.add_argument(
        "--processes",
        type=_processes,
        default=5,
        metavar="N",
        help="pairs of processes that a comparison starts, 3 to 20 (default: 5); more find smaller "
        "differences",
    )


def run(args: argparse.Namespace) -> int:
    """Measure everything, write it as it comes, and print it; returns the exit code.

    Raises:
        UsageError: Options do not go together, or a model does not take its own.
        ValueError: There is no such class or revision, or results are already there.
        OSError: There is no such model, or the output cannot be written.
    """
    from trainer.benchmarking import files, machine
    from trainer.benchmarking.cases import Effort, Method, cases_of
    from trainer.benchmarking.session import Session
    from trainer.outputs import make_folder, refuse_existing
    from trainer.progress import FrameProgress

    methods = list(dict.fromkeys(Method(model, tuple(options)) for model, options in args.models))
    _check_together(args, methods)
    _check_models(args, methods)
    if args.output is not None:
        refuse_existing(files.paths(args.output), args.force)
        make_folder(args.output)
    results = files.Results(args.output, machine.describe())
    cases = cases_of(methods, _chosen(args), spp=args.spp, memory=args.memory)
    unit = "comparison" if args.pair or args.revisions else "case"
    repeat, seconds = (4, 60.0) if unit == "comparison" else (15, 20.0)
    effort = Effort(args.repeat or repeat, args.warmup, args.seconds or seconds)
    with FrameProgress(len(cases) // (1 + args.pair), title="measuring", unit=unit) as progress:
        session = Session(progress, effort, args.processes, results.keep)
        try:
            interrupted = not _measured(args, session, cases)
        finally:
            written = results.finish(session.outcomes, session.comparisons)
    if interrupted:
        plural = "s" * (progress.total != 1)
        print(f"interrupted: {progress.done} of {progress.total} {unit}{plural} measured", file=sys.stderr)
    _print(results.machine, session)
    if written:
        print(f"written: {', '.join(map(str, written))}", file=sys.stderr)
    if interrupted:
        return INTERRUPTED
    enough = all if args.strict else any
    return 0 if session.outcomes and enough(outcome.done for outcome in session.outcomes) else 1


def _chosen(args: argparse.Namespace) -> dict[str, list[Any]]:
    """Return the settings that cases are made of, without repetitions."""
    chosen = {
        "kind": args.kind or ["inference"],
        "size": args.size,
        "batch": [number for numbers in args.batch or [] for number in numbers],
        "precision": args.precision or ["float32"],
        "device": args.device or ["cpu"],
        "mode": args.mode or ["eager"],
    }
    return {name: list(dict.fromkeys(values or [])) for name, values in chosen.items()}


def _measured(args: argparse.Namespace, session: Session, cases: list[Case]) -> bool:
    """Measure or compare; returns whether everything is done, not interrupted before."""
    half = len(cases) // 2
    try:
        if args.pair:
            session.compare_models(zip(cases[:half], cases[half:], strict=True))
        elif args.revisions:
            session.compare_revisions(cases, args.revisions)
        else:
            session.measure(cases)
    except KeyboardInterrupt:
        return False
    return True


def _check_together(args: argparse.Namespace, methods: list[Method]) -> None:
    """Raise a UsageError where options do not go together."""
    if args.pair and args.revisions:
        raise UsageError("--pair compares two models and --revisions two revisions of one: use one of them")
    if args.pair and len(methods) != 2:
        raise UsageError(f"--pair compares two models: expected two different --model, got {len(methods)}")
    if args.pair and {method.format for method in methods} != {None} and len(set(args.mode or [])) > 1:
        raise UsageError("--pair with an exported file, which has one mode: give at most one --mode")
    if args.revisions and len(methods) != 1:
        raise UsageError(f"--revisions compares one model: expected one --model, got {len(methods)}")
    if args.revisions and args.revisions[0] == args.revisions[1]:
        raise UsageError(f"--revisions: expected two different revisions, got {args.revisions[0]} twice")


def _check_models(args: argparse.Namespace, methods: list[Method]) -> None:
    """Find mistyped models and options before anything is measured; raises as `check_named`."""
    from trainer.loading import check_named

    here = not args.revisions or "." in args.revisions
    for method in methods:
        if here or not method.is_class:  # other revisions may have other classes and options
            check_named(method.model, method.options)


def _print(about: dict[str, Any], session: Session) -> None:
    from rich.console import Console

    from trainer.benchmarking import machine
    from trainer.benchmarking.table import WIDTH, comparison_lines, remarks, table

    if not session.outcomes:
        return
    console = Console(width=WIDTH if not sys.stdout.isatty() else min(Console().width, WIDTH))
    console.print(table(session.outcomes))
    lines = remarks(session.outcomes)
    for comparison in session.comparisons:
        lines += comparison_lines(comparison)
    for line in [*lines, machine.in_words(about)]:
        console.print(line, highlight=False, markup=False)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip().lower())
    if match is None or min(int(match[1]), int(match[2])) < 16:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no size; expected width x height in pixels, such as 1280x720, at least 16x16"
        )
    return int(match[1]), int(match[2])


def _batches(text: str) -> list[int]:
    return [_positive(part) for part in text.split(",")]


def _positive(text: str) -> int:
    if not text.strip().isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return int(text)


def _processes(text: str) -> int:
    number = _positive(text)
    if not 3 <= number <= 20:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 3 to 20")
    return number


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds above 0")
    return value
