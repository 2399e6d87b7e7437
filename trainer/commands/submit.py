"""`trainer submit`: a training, or many independent jobs, on a Ray cluster."""

from __future__ import annotations

import argparse
import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainer.cluster.fitting import Group

HELP = "run a training, or many independent jobs, on a Ray cluster"

DESCRIPTION = """\
Runs what `trainer fit`, `render`, `prepare` or `evaluate` run, spread over machines:

  trainer submit --config wskp_bmfr.yaml --workers 8 --gpus-per-worker 1 --address ray://head:10001
  trainer submit render stills --random 100 --output /shared/frames --workers 64 --address auto
  trainer submit prepare /shared/frames --output /shared/shards --workers 16 --address auto

All other options are those of the command, and are checked before anything starts. Without --address a Ray of
its own is started on this machine and ended afterwards. The exit status is that of the command.
"""
VERBS = ("render", "prepare", "evaluate")
PASSES_ON = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options; those of the command that is run are passed on."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = DESCRIPTION
    parser.allow_abbrev = False
    parser.usage = (
        "trainer submit [fit | render | prepare | evaluate] [options below] [options of the command]"
    )
    add_cluster_options(parser)
    parser.add_argument(
        "--storage",
        metavar="URL",
        help="trainings: where the run is mirrored, a folder that all nodes share or s3://bucket/path; a run "
        "whose node is lost goes on from there",
    )
    parser.add_argument(
        "--max-failures", type=int, metavar="N", help="restarts after lost workers (default 3)"
    )


def add_cluster_options(parser: argparse.ArgumentParser) -> None:
    """Define which cluster is used, and how many of its processes."""
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default 1)")
    parser.add_argument("--cpus-per-worker", type=int, metavar="C", help="cores of each (default 1)")
    parser.add_argument("--gpus-per-worker", type=float, metavar="G", help="GPUs of each (default 0)")
    parser.add_argument(
        "--address",
        metavar="URL",
        help="a running Ray: ray://HOST:10001 from any machine, auto or HOST:6379 on one of its nodes "
        "(default: start one)",
    )
    parser.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        help="working folder of the processes, made on every node where absent (default: this one)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the command on the cluster and return its exit code.

    Raises:
        UsageError: An option is wrong; nothing was started.
        ValueError: Ray is missing, or the cluster has another release of Penumbra.
        OSError: The cluster cannot be reached.
    """
    from trainer.cluster.engine import need_ray
    from trainer.configs import UsageError

    group = group_of(args, max_failures=3)
    verb, rest = _verb(args.rest)
    need_ray()
    folder = Path(os.path.abspath(args.folder or Path.cwd()))
    if verb == "fit":
        from trainer.cluster.checked import check_training
        from trainer.cluster.fitting import submit_training

        return submit_training(check_training(rest), group, args.address, folder, args.storage)
    if args.storage is not None:
        raise UsageError(f"--storage is for trainings; {verb} writes to its --output")
    from trainer.cluster.spreading import Spread, check_verb, submit_verb

    check_verb(verb, rest)
    spread = Spread(group.workers, group.cpus, group.gpus, group.max_failures)
    return submit_verb(verb, rest, spread, args.address, folder)


def group_of(args: argparse.Namespace, max_failures: int) -> Group:
    """Return the processes that the options ask for.

    Args:
        args: The options; those that were not given are None.
        max_failures: What is meant where that is not given.

    Raises:
        UsageError: A number is out of range.
    """
    from trainer.cluster.fitting import Group
    from trainer.configs import UsageError

    found = []
    for name, default, least in (
        ("workers", 1, 1), ("cpus_per_worker", 1, 1), ("gpus_per_worker", 0, 0),
        ("max_failures", max_failures, 0),
    ):  # fmt: skip
        value = getattr(args, name)
        if value is not None and value < least:
            option = "--" + name.replace("_", "-")
            raise UsageError(f"{option} {value}: expected at least {least}")
        found.append(default if value is None else value)
    return Group(*found)


def _verb(rest: list[str]) -> tuple[str, list[str]]:
    """Return the command that is meant, `fit` where none is named, and its arguments."""
    import difflib

    from trainer.configs import UsageError

    if not rest or rest[0].startswith("-"):
        verb, arguments = "fit", rest
    else:
        verb, arguments = rest[0], rest[1:]
    if verb not in ("fit", *VERBS):
        near = difflib.get_close_matches(verb, ("fit", *VERBS), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise UsageError(f"{verb!r} cannot be submitted{hint} (fit, {', '.join(VERBS)})")
    if verb == "fit" and not any(word.partition("=")[0] in ("--config", "-c") for word in arguments):
        raise UsageError("nothing to train: give --config NAME")
    if verb != "fit" and not hasattr(importlib.import_module(f"trainer.commands.{verb}"), "check"):
        raise UsageError(f"{verb!r} cannot be submitted")
    return verb, arguments
