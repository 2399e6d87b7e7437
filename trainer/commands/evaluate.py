"""`trainer evaluate`: compare denoisers on the same frames."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.commands.denoise import size_in_bytes
from trainer.options import AddModel, AddOption

if TYPE_CHECKING:
    import pandas as pd

    from trainer.clips import Clip
    from trainer.evaluation.cells import Table
    from trainer.evaluation.plan import Method, Setting
    from trainer.evaluation.running import Outcome
    from trainer.evaluation.tables import Scored

HELP = "compare denoisers on the same frames: metrics, tables, a report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "--model",
        dest="models",
        action=AddModel,
        required=True,
        metavar="[LABEL=]MODEL",
        help="a method, as of `trainer denoise`, or OIDN; repeat it for each; LABEL is its name in tables",
    )
    parser.add_argument(
        "--option",
        dest="models",
        action=AddOption,
        metavar="KEY=VALUE",
        help="option of the --model before it, where that is named by its class, such as preset=paper",
    )
    parser.add_argument(
        "--data",
        required=True,
        metavar="ROOT",
        help="ingested data set, folder of a known layout or of EXR files, or sample:NAME",
    )
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for everything")
    parser.add_argument(
        "--split",
        choices=("auto", "train", "validation", "test", "all"),
        default="auto",
        help="which scenes of a data set (default: its test scenes, all where it has none)",
    )
    parser.add_argument(
        "--metric",
        action="append",
        dest="metrics",
        metavar="NAME",
        help="take only this metric; may be repeated (default: all)",
    )
    _add_course(parser)
    _add_keeping(parser)


def _add_course(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:1 … (default: cpu)")
    parser.add_argument(
        "--memory",
        type=size_in_bytes,
        default=size_in_bytes("2GB"),
        metavar="SIZE",
        help="memory that a method may take, larger images are tiled (default: 2GB)",
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="processes that take metrics meanwhile (default: 1)"
    )
    parser.add_argument(
        "--no-costs",
        action="store_true",
        help="do not measure time and memory of the methods (never done on a cluster)",
    )


def _add_keeping(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--force", action="store_true", help="discard an evaluation of other frames in the output folder"
    )
    parser.add_argument("--no-track", action="store_true", help="do not record the evaluation in MLflow")
    parser.add_argument(
        "--register-champion",
        metavar="METRIC",
        help="of the registered versions among the models (models:/NAME/3): move the alias `champion` to the "
        "best one, unless a scene gets worse than with the champion so far, which is evaluated too",
    )
    parser.add_argument(
        "--tolerance",
        type=_share,
        default=0.01,
        metavar="SHARE",
        help="by how much of its value a scene may get worse for a new champion (default: 0.01)",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="exit with 1 if any method or frame is left out, or returned NaN",
    )


def check(args: argparse.Namespace) -> None:
    """Check the options alone; nothing is read.

    Raises:
        UsageError: Some do not fit.
    """
    from trainer.configs import UsageError
    from trainer.evaluation.plan import methods_of

    _metrics(args.metrics)
    try:
        methods_of(args.models)
    except ValueError as error:
        raise UsageError(str(error)) from None


def run(args: argparse.Namespace) -> int:
    """Evaluate; returns the exit code.

    Raises:
        UsageError: A metric is unknown, or labels are the same.
        ValueError: There is nothing to evaluate, or the folder holds something else.
        OSError: A file cannot be read or written.
    """
    from data.jobs import elsewhere
    from trainer.commands.denoise import check_device
    from trainer.evaluation.champion import champions_beside
    from trainer.evaluation.keeping import identity_of, take_folder
    from trainer.evaluation.plan import Setting, clips_of, methods_of
    from trainer.evaluation.record import rows_of
    from trainer.evaluation.results import record_files, write_results
    from trainer.evaluation.running import Evaluation
    from trainer.evaluation.tables import Scored
    from trainer.loading import check_named, model_store
    from trainer.progress import FrameProgress

    if elsewhere() is None:  # on a cluster, the devices are those of its workers
        check_device(args.device)
    metrics = _metrics(args.metrics)
    methods = methods_of(args.models)
    if args.register_champion:
        (judge,) = _metrics([args.register_champion])
        metrics = tuple(dict.fromkeys([*metrics, judge]))
        methods = methods_of([*args.models, *champions_beside(methods, model_store())])
    for method in methods:
        check_named(method.model, method.options)
    clips, split = clips_of(args.data, args.split)
    names = _frames(clips)
    identity = identity_of(args.data, clips)
    take_folder(args.output, identity, args.data, args.force)
    setting = Setting(
        args.data, split, identity, names, args.output, metrics, args.device, args.memory, args.jobs
    )
    _announce(methods, len(names), split)
    with FrameProgress(len(names) * (len(methods) + 1)) as progress:
        outcomes = Evaluation(setting, progress).run(methods)
    rows = rows_of(outcomes, setting)
    costs = not args.no_costs and elsewhere() is None
    tables, tracked = write_results(outcomes, rows, setting, _say, costs, record=not args.no_track)
    if tracked is not None:
        record_files(tracked, args.output, _say)
    if args.register_champion:
        _crown(methods, Scored(rows, [o.method.label for o in outcomes], metrics), args)
    _print(outcomes, rows, tables, setting)
    return _status(outcomes, args.strict)


def _frames(clips: Sequence[Clip]) -> dict[str, str | None]:
    """Return the names of all frames in order, and for each that of the preceding one of its sequence."""
    names: dict[str, str | None] = {}
    for clip in clips:
        before: str | None = None
        for item in clip.items:
            names[item.name], before = before, item.name if clip.sequence else None
    return names


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no share; expected a number from 0 to 1, such as 0.01")
    return value


def _crown(methods: Sequence[Method], scored: Scored, args: argparse.Namespace) -> None:
    """Move the alias of each registered model, or say why it stays."""
    from trainer.evaluation.champion import champion_of, decide, move, registered
    from trainer.loading import model_store

    uri = model_store()
    found = registered(methods, uri)
    for name in dict.fromkeys(entry.name for entry in found):
        entries = [entry for entry in found if entry.name == name]
        decision = decide(scored, entries, champion_of(name, uri), args.register_champion, args.tolerance)
        if decision.moves:
            move(decision, uri)
        print(decision.text(), file=sys.stderr)


def _metrics(named: Sequence[str] | None) -> tuple[str, ...]:
    import difflib

    from trainer.configs import UsageError
    from trainer.metrics.measures import LEFT_OUT, SCORES

    for name in named or ():
        if name in LEFT_OUT:
            raise UsageError(f"--metric {name}: {LEFT_OUT[name]}")
        if name not in SCORES:
            near = difflib.get_close_matches(name, SCORES, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise UsageError(f"--metric {name}: unknown{hint} (there are {', '.join(SCORES)})")
    return tuple(name for name in SCORES if not named or name in named)


def _announce(methods: Sequence[Method], frames: int, split: str | None) -> None:
    which = f"of the {split} split" if split else "in all"
    plural = "s" * (frames != 1)
    print(
        f"{len(methods)} method{'s' * (len(methods) != 1)} on {frames} frame{plural} {which}", file=sys.stderr
    )


def _print(
    outcomes: Sequence[Outcome], rows: pd.DataFrame, tables: Sequence[Table], setting: Setting
) -> None:
    """Print the overviews, and what is missing; everything is written by now."""
    from trainer.reports.tables import print_overviews

    print_overviews([table for table in tables if table.name.startswith("overview")])
    for outcome in outcomes:
        if told := outcome.told():
            _say(f"{outcome.method.label}: {outcome.status}: {told}")
    noisy = outcomes[0].rows.values()
    lacking = sum(not row.get("reference", True) for row in noisy)
    if lacking:
        _say(f"{lacking} frame{'s have' if lacking > 1 else ' has'} no reference: denoised, without metrics")
    if repaired := sum(row.get("repaired", 0) > 0 for row in noisy):
        _say(f"{repaired} references have NaN or Inf pixels, which were replaced by their neighbours")
    empty = [name for name in setting.metrics if rows[name].isna().all()]
    if empty and lacking < len(noisy):
        _say(
            f"no frame has {', '.join(empty)}: those of successive frames need a sequence with motion or "
            "positions, ms_ssim_gamma 176x176 pixels"
        )
    _say(f"written to {setting.folder}; look at {setting.folder / 'report.html'}")


def _status(outcomes: Sequence[Outcome], strict: bool) -> int:
    good = [outcome for outcome in outcomes[1:] if outcome.status != "skipped"]
    whole = all(outcome.told() is None for outcome in outcomes)
    return 0 if good and (whole or not strict) else 1
