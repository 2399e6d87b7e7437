"""`trainer ablate`: train variants of a configuration and tabulate them."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainer.ablation.fitting import Fitted
    from trainer.ablation.plan import Ablation
    from trainer.ablation.variants import Training

HELP = "train variants of a configuration and tabulate them"

DESCRIPTION = """\
Trains every variant that a file lists, one after the other, evaluates all on the held-out scenes, and writes
tables (Markdown, LaTeX, CSV) and plots (PNG, PDF): metrics, parameters, time of a frame.

  trainer ablate --config ablations/wskp_kernels.yaml --output kernels
  trainer ablate --config ablations/wskp_branches.yaml --output branches --data.root DATA

Other options, and further --config files, are those of `trainer fit`, for all variants. The same command goes
on after an interruption: what was trained is not trained again, a training that was stopped continues, one
that failed is tried again. A file of your own lists `variants`, each with a `name`, `options` (keys of the
configuration and values) and optionally a `config`; trainer/ablation/plan.py shows all that it may say.
"""
PASSES_ON = True
EVALUATION = "evaluation"
SCORED = ("best", "last")
"""Checkpoints that are compared, the first that there is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options; those of `trainer fit` are passed on."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = DESCRIPTION
    parser.allow_abbrev = False
    parser.usage = "trainer ablate --config A.yaml --output DIR [options below] [options of `trainer fit`]"
    parser.add_argument(
        "--config",
        "-c",
        action="append",
        required=True,
        metavar="A.yaml",
        help="first the ablation, a file or the name of a shipped one; then what is laid over each variant's "
        "configuration",
    )
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for everything")
    parser.add_argument(
        "--frames",
        metavar="ROOT",
        help="frames to compare on, as --data of `trainer evaluate` (default: test scenes of the training "
        "data)",
    )
    parser.add_argument("--device", default="cpu", help="of the comparison: cpu, cuda … (default: cpu)")
    parser.add_argument(
        "--force", action="store_true", help="discard a comparison on other frames in the output folder"
    )


def run(args: argparse.Namespace) -> int:
    """Train, compare, tabulate; returns 0 where every variant is in the tables.

    Raises:
        UsageError: The file, an option or a value is wrong; nothing was started.
        ValueError: The folder holds something else or another process works in it, or there are no frames to
            compare on.
        OSError: A file cannot be read or written.
    """
    from trainer.ablation.parent import alone, take_folder
    from trainer.ablation.plan import find_ablation, read_ablation
    from trainer.ablation.variants import trainings_of
    from trainer.commands.denoise import check_device
    from trainer.evaluation import keeping
    from trainer.evaluation.plan import clips_of

    check_device(args.device)
    ablation = read_ablation(find_ablation(args.config[0]))
    overlays = [word for name in args.config[1:] for word in ("--config", name)]
    trainings = trainings_of(ablation, [*overlays, *args.rest])
    frames, split = (args.frames, "auto") if args.frames else (trainings[0].data, "test")
    try:
        clips, _ = clips_of(frames, split)
    except (ValueError, OSError) as error:
        raise ValueError(f"no frames to compare on: {error}; name a data set with --frames ROOT") from None
    with alone(args.output):
        identity = take_folder(args.output, ablation.name)
        # Now, not after the trainings: it may hold a comparison on other frames.
        shown = keeping.identity_of(frames, clips)
        keeping.take_folder(args.output / EVALUATION, shown, frames, args.force)
        return _train_and_compare(ablation, trainings, identity, (frames, split), args)


def _train_and_compare(
    ablation: Ablation,
    trainings: Sequence[Training],
    identity: str,
    data: tuple[str, str],
    args: argparse.Namespace,
) -> int:
    """Train and compare below one run; returns the exit code."""
    from trainer.ablation.fitting import fit_all
    from trainer.ablation.parent import ParentRun

    parent = ParentRun(ablation, trainings, args.output, _say)
    good = False
    try:
        trained = fit_all(trainings, identity, parent.tags(), args.output / "logs", _say)
        fitted = [_with_checkpoint(one) for one in trained]
        parent.note(fitted)
        failed = [one for one in fitted if one.run is None]
        if len(failed) < len(fitted):
            good = _compare(ablation, fitted, *data, args) and not failed
            parent.keep()
    finally:
        parent.end(good)
    for one in failed:
        _say(f"{one.name}: failed: {one.reason}")
    return 0 if good else 1


def _with_checkpoint(one: Fitted) -> Fitted:
    """Return a variant as failed where nothing of it is left to compare: the others are compared still."""
    if one.run is None or any((one.run / "checkpoints" / f"{name}.ckpt").is_file() for name in SCORED):
        return one
    return replace(one, run=None, reason=f"{one.run} holds no checkpoint; remove that folder to train again")


def _compare(
    ablation: Ablation, fitted: Sequence[Fitted], frames: str, split: str, args: argparse.Namespace
) -> bool:
    """Evaluate what was trained and write tables and plots; returns whether that went well."""
    import pandas as pd

    from trainer.ablation.plots import write_plots
    from trainer.ablation.tables import Measured, tables_of, write_tables
    from trainer.reports.tables import print_overviews

    trained = [one for one in fitted if one.run is not None]
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):  # its tables are not those of variants
        code = _evaluate(ablation, trained, frames, split, args)
    folder = args.output / EVALUATION
    rows = pd.read_parquet(folder / "rows.parquet")
    record = json.loads((folder / "evaluation.json").read_text())
    failed = {one.name: f"failed: {one.reason}" for one in fitted if one.run is None}
    measured = Measured.of(rows, record, ablation.metrics, failed)
    tables = tables_of(ablation, measured)
    write_tables(args.output, tables)
    plots = write_plots(args.output, ablation, measured)
    print_overviews(tables)
    _say(f"written to {args.output}: {len(tables)} tables in tables, {len(plots)} files in plots")
    return code == 0 and not measured.failed


def _evaluate(
    ablation: Ablation, trained: Sequence[Fitted], frames: str, split: str, args: argparse.Namespace
) -> int:
    """Run `trainer evaluate` on the variants."""
    from trainer.commands import evaluate
    from trainer.training import evaluated

    # With a sign: a name may begin with a hyphen.
    words = [f"--data={frames}", "--split", split, f"--output={args.output / EVALUATION}"]
    words += ["--device", args.device, *(["--force"] if args.force else [])]
    for one in trained:
        words += [f"--model={one.name}={evaluated(str(one.run), one.training.root, '')}"]
    for metric in ablation.metrics:
        words += ["--metric", metric]
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    return evaluate.run(parser.parse_args(words))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
