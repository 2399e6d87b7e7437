"""Independent jobs, and where they run: processes of this machine, unless something is put in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True)
class Job:
    """A call of a module's function whose place and order do not matter to the result.

    Attributes:
        name: What a person calls it.
        function: What is called; made again after a failure, it goes on or begins anew.
        arguments: Its arguments; they and the result travel between machines.
        sees: Files that must exist where it runs, which shows that the folder is shared.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    sees: tuple[Path, ...] = ()


Done = Callable[[Job | None, Any], None]
"""Called with a job and its result, and now and then with None while nothing ends."""


class Runner(Protocol):
    """Runs jobs.

    Attributes:
        workers: How many run at one time.
        cores: Processor cores that each may use.
    """

    workers: int
    cores: int

    def __call__(self, jobs: Sequence[Job], done: Done) -> None:
        """Run jobs to the end of all.

        Raises:
            ValueError: Some failed; names them.
        """


_runner: Runner | None = None


def elsewhere() -> Runner | None:
    """Return what runs jobs instead of this machine's processes, None where nothing does."""
    return _runner


@contextmanager
def run_elsewhere(runner: Runner) -> Iterator[None]:
    """Let a runner do the jobs of the commands that are called meanwhile."""
    global _runner
    before, _runner = _runner, runner
    try:
        yield
    finally:
        _runner = before
