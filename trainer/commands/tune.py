"""`trainer tune`: search hyper-parameters with Ray Tune."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trainer.cluster.fitting import Group
    from trainer.cluster.sweep import Search

HELP = "search hyper-parameters with Ray Tune"

DESCRIPTION = """\
Trains a configuration many times with changed values: Optuna proposes them, ASHA stops trials that fall
behind. Score (a validation number) and cost (milliseconds per megapixel of the deployed network) are both
objectives.

  trainer tune --config wskp_bmfr.yaml --space wskp_bmfr.yaml --trials 20

A space is a YAML file that names keys of the configuration:

  model.net.layers: {choice: [2, 4, 6]}
  model.optimizer.init_args.lr: {loguniform: [0.0005, 0.02]}

Other options are those of `trainer fit`. The results, and a best.yaml that `trainer fit --config` takes, are
written to runs/tune/NAME; --resume runs/tune/NAME goes on with a search that was interrupted.
"""
PASSES_ON = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options; those of `trainer fit` are passed on."""
    from trainer.commands.submit import add_cluster_options

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = DESCRIPTION
    parser.allow_abbrev = False
    parser.usage = "trainer tune --config X.yaml --space S.yaml [options below] [options of `trainer fit`]"
    parser.add_argument(
        "--space", metavar="S.yaml", help="what is varied: a file, or the name of a shipped one"
    )
    parser.add_argument("--trials", type=int, metavar="N", help="number of trials (default 20)")
    parser.add_argument("--metric", help="logged by validation (default val/psnr_wskp)")
    parser.add_argument("--mode", choices=("max", "min"), help="what is better (default max)")
    parser.add_argument(
        "--grace", type=int, metavar="E", help="epochs before a trial may be stopped (default: a quarter)"
    )
    parser.add_argument(
        "--no-early-stop", action="store_true", help="train all trials to the end, for a fair Pareto front"
    )
    parser.add_argument("--concurrent", type=int, metavar="N", help="trials at one time, at most")
    parser.add_argument("--search-seed", type=int, metavar="N", help="of the search (default 1)")
    parser.add_argument("--resume", metavar="DIR", type=Path, help="go on with the search in this folder")
    parser.add_argument(
        "--max-failures", type=int, metavar="N", help="restarts of a trial that fails (default 1)"
    )
    add_cluster_options(parser)


def run(args: argparse.Namespace) -> int:
    """Search; returns 0 where at least one trial was trained to the end.

    Raises:
        UsageError: An option or the space is wrong; nothing was started.
        ValueError: Ray is missing, or there is no search to resume.
        OSError: The cluster cannot be reached.
    """
    from trainer.cluster.engine import need_ray
    from trainer.commands.submit import group_of

    group = group_of(args, max_failures=1)
    need_ray()
    from trainer.cluster.sweep import run_search

    if args.resume is None:
        return run_search(_search(args, group), args.address)
    results = Path(os.path.abspath(args.resume))
    return run_search(_resumed(args, results), args.address, results)


def _resumed(args: argparse.Namespace, results: Path) -> Search:
    """Return a search as it was begun; only how many of its trials run at one time may change.

    Raises:
        UsageError: An option asks for something else.
        ValueError: There is no search.
    """
    from trainer.cluster.sweep import Search
    from trainer.configs import UsageError

    search = Search.load(results)
    group = search.group
    begun = {
        "trials": search.trials, "metric": search.metric, "mode": search.mode, "grace": search.grace,
        "search_seed": search.seed, "workers": group.workers, "cpus_per_worker": group.cpus,
        "gpus_per_worker": group.gpus, "max_failures": group.max_failures,
        "no_early_stop": not search.reduction,
    }  # fmt: skip
    for name, value in begun.items():
        given = getattr(args, name)
        if given is not None and given is not False and given != value:
            option = "--" + name.replace("_", "-")
            option, was = (option, "without") if given is True else (f"{option} {given}", f"with {value}")
            raise UsageError(
                f"{option}: the search in {args.resume} was begun {was}, and --resume goes on with it as it "
                "was; leave the option out, or begin a new search"
            )
    other = ["--space"] * (args.space is not None) + [word for word in args.rest if word.startswith("-")]
    if other:
        raise UsageError(
            f"{other[0]}: --resume goes on with the search as it was begun; leave the option out"
        )
    folder = os.path.abspath(args.folder) if args.folder else search.folder or os.getcwd()
    return replace(search, concurrent=args.concurrent or search.concurrent, folder=folder)


def _search(args: argparse.Namespace, group: Group) -> Search:
    from trainer.cluster.checked import check_training, parsed
    from trainer.cluster.space import check_space, find_space, read_space
    from trainer.cluster.sweep import Search
    from trainer.configs import UsageError, resolve_arguments

    if args.space is None or not any(word.partition("=")[0] in ("--config", "-c") for word in args.rest):
        raise UsageError("nothing to search: give --config X.yaml and --space S.yaml")
    path = find_space(args.space)
    space = read_space(path)
    training = check_training(args.rest)
    epochs = _epochs(parsed(resolve_arguments(args.rest)).trainer)
    grace = args.grace or max(1, epochs // 4)
    trials = 20 if args.trials is None else args.trials
    for name, value, high in (("--trials", trials, None), ("--grace", grace, epochs)):
        if value < 1 or (high is not None and value > high):
            most = f" to {high}, the epochs of a trial" if high else " or more"
            raise UsageError(f"{name} {value}: expected 1{most}")
    check_space(space, args.rest, path)
    return Search(
        training, space, trials, group, args.metric or "val/psnr_wskp", args.mode or "max", epochs, grace,
        0 if args.no_early_stop else 3, 1 if args.search_seed is None else args.search_seed,
        args.concurrent or 0, os.path.abspath(args.folder or Path.cwd()),
    )  # fmt: skip


def _epochs(trainer: Any) -> int:
    from trainer.configs import UsageError

    epochs = trainer.max_epochs
    if epochs is None or epochs < 1:
        raise UsageError("a search compares trials by epochs: give --trainer.max_epochs N")
    return int(epochs)
