"""`trainer submit VERB`: a command whose independent jobs run as tasks on a Ray cluster."""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.jobs import Done, Job, run_elsewhere
from trainer.cluster.board import conduct, reason, sending
from trainer.cluster.engine import Cluster, enter, forwarded

BEAT_S = 0.5
"""Seconds after which a command hears that its jobs still run."""

TOLD = 5
"""Failed jobs that are told of in full."""


@dataclass(frozen=True)
class Spread:
    """How the jobs of a command are spread.

    Attributes:
        workers: How many run at one time.
        cpus: Processor cores of each.
        gpus: GPUs of each.
        retries: How often a job that failed is made again.
    """

    workers: int = 1
    cpus: int = 1
    gpus: float = 0
    retries: int = 3


def check_verb(verb: str, arguments: Sequence[str]) -> None:
    """Check the options of a command without running it.

    Raises:
        UsageError: A value is wrong.
        SystemExit: The parser has said what is wrong.
    """
    command = importlib.import_module(f"trainer.commands.{verb}")
    parser = argparse.ArgumentParser(prog=f"trainer submit {verb}", description=command.HELP)
    command.add_arguments(parser)
    command.check(parser.parse_args(list(arguments)))


def submit_verb(
    verb: str, arguments: Sequence[str], spread: Spread, address: str | None, folder: Path
) -> int:
    """Run a command in the cluster, its jobs spread over it, and print what it prints; returns its exit code.

    Args:
        verb: A command that gives its jobs to `data.jobs.elsewhere()`.
        arguments: Its command line.
        spread: How the jobs are spread.
        address: A running Ray, or None for one on this machine.
        folder: Working folder of the processes.

    Raises:
        ValueError: Ray is missing, or the cluster has another release.
        OSError: The cluster cannot be reached.
        KeyboardInterrupt: Ctrl-C, after the jobs were cancelled.
    """
    cluster = Cluster(address, spread.workers, spread.cpus, spread.gpus, together=False)
    return conduct(cluster, _Conductor, verb, list(arguments), spread, str(folder), forwarded(address))


class _Conductor:
    """Runs a command within the cluster."""

    def run(
        self,
        verb: str,
        arguments: list[str],
        spread: Spread,
        folder: str,
        environment: dict[str, str],
        board: Any,
    ) -> None:
        """Run a command as `trainer VERB` does."""
        import ray

        with sending(board):
            try:
                enter(folder, environment)
                code = _main(verb, arguments, RayJobs(spread, folder, environment, board))
            except OSError as error:
                ray.get(board.end.remote(1, str(error)))
                return
            except KeyboardInterrupt:
                code = 130
        ray.get(board.end.remote(code))


def _main(verb: str, arguments: Sequence[str], runner: RayJobs) -> int:
    from trainer.cli import main

    sys.argv = ["trainer", verb, *arguments]
    with run_elsewhere(runner):
        try:
            return main()
        except SystemExit as end:
            return end.code if isinstance(end.code, int) else 1


class RayJobs:
    """Runs jobs as Ray tasks, so many at one time.

    Args:
        spread: How many, and what each may use.
        folder: Working folder of the tasks.
        environment: Their variables.
        board: Where a cancellation is seen.
    """

    def __init__(self, spread: Spread, folder: str, environment: dict[str, str], board: Any) -> None:
        self._spread, self._place, self._board = spread, (folder, environment), board
        self.workers, self.cores = spread.workers, spread.cpus

    def __call__(self, jobs: Sequence[Job], done: Done) -> None:
        """Run jobs; one that fails is made again, and others go on meanwhile.

        Raises:
            ValueError: Jobs failed each time; names them.
            KeyboardInterrupt: The submitter cancelled them.
        """
        import ray

        task = ray.remote(num_cpus=self._spread.cpus, num_gpus=self._spread.gpus, max_retries=0)(_do)
        waiting = deque((job, 0) for job in jobs)
        running: dict[Any, tuple[Job, int]] = {}
        failed: dict[str, str] = {}
        while waiting or running:
            while waiting and len(running) < self._spread.workers:
                job, tries = waiting.popleft()
                running[task.remote(job, *self._place)] = (job, tries)
            ended, _ = ray.wait(list(running), timeout=BEAT_S)
            if ray.get(self._board.cancelled.remote()):
                for reference in running:
                    ray.cancel(reference, force=True)
                raise KeyboardInterrupt
            for reference in ended:
                job, tries = running.pop(reference)
                result, failure = _result(ray, reference)
                if failure is None:
                    done(job, result)
                elif tries < self._spread.retries:
                    print(f"{job.name} failed and is made again: {failure}", file=sys.stderr)
                    waiting.append((job, tries + 1))
                    time.sleep(min(2.0**tries, 8.0) if not running else 0)
                else:
                    print(f"{job.name} failed: {failure}", file=sys.stderr)
                    failed[job.name] = failure
            if not ended:
                done(None, None)
        if failed:
            raise ValueError(_account(failed, len(jobs)))


def _do(job: Job, folder: str, environment: dict[str, str]) -> tuple[bool, Any]:
    """Do a job in a process of the cluster; returns whether it was done, and its result or what failed."""
    import os

    try:
        enter(folder, environment)
        missing = next((path for path in job.sees if not path.exists()), None)
        if missing is not None:
            raise OSError(
                f"{missing} is not there on node {os.uname().nodename}; source and output must lie in "
                "folders that all nodes share, under the same path"
            )
        with tempfile.TemporaryFile("w") as quiet:  # lines of jobs side by side tell nothing
            from contextlib import redirect_stdout

            with redirect_stdout(quiet):
                return True, job.function(*job.arguments)
    except (ValueError, OSError, RuntimeError) as error:
        return False, str(error) or type(error).__name__


def _result(ray: Any, reference: Any) -> tuple[Any, str | None]:
    try:
        good, result = ray.get(reference)
    except ray.exceptions.RayError as error:
        return None, reason(error)
    return (result, None) if good else (None, str(result))


def _account(failed: dict[str, str], count: int) -> str:
    told = "; ".join(f"{name}: {reason}" for name, reason in list(failed.items())[:TOLD])
    more = f"; and {len(failed) - TOLD} more" if len(failed) > TOLD else ""
    rest = "the others are finished and kept: " if len(failed) < count else ""
    return f"{len(failed)} of {count} jobs failed ({told}{more}); {rest}the same command goes on from there"
