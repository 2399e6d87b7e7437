"""The same work on many things in several processes; what all calls share is sent to each process once."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from data.shards.processes import end_with_parent

Thing = TypeVar("Thing")
Result = TypeVar("Result")

MOST_TOGETHER = 64
"""Neighbours that go to one process together: they often lie in one block of one file."""

_work: Callable[[Any], Any] | None = None


def results(
    work: Callable[[Thing], Result],
    things: Sequence[Thing],
    processes: int,
    begin: Callable[[], None] | None = None,
) -> Iterator[tuple[Thing, Result]]:
    """Yield each thing with its result, in order in this process, as they come from several.

    Args:
        work: Called with each thing. Pickled once per process, so it may carry much, things should not.
        things: In an order in which neighbours share work.
        processes: Number of processes.
        begin: Called in each process before its first work.

    Raises:
        OSError: A process was ended from outside.
        Exception: What the first failing call raised; work that has not begun is left out.
    """
    processes = min(processes, len(things))
    if processes <= 1:
        yield from ((thing, work(thing)) for thing in things)
        return
    # spawn: the EXR library keeps threads, which do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _begin, (work, begin)) as pool:
        pending = {pool.submit(_several, group): group for group in groups(things, processes)}
        try:
            for future in as_completed(list(pending)):
                yield from zip(pending.pop(future), future.result(), strict=True)
        except BrokenProcessPool as error:
            raise OSError(
                "a process that reads frames was ended from outside, perhaps for want of memory; "
                "use fewer --processes"
            ) from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def groups(things: Sequence[Thing], processes: int) -> list[Sequence[Thing]]:
    """Return neighbours together, in groups small enough to keep all processes busy to the end."""
    size = max(1, min(MOST_TOGETHER, len(things) // (16 * processes)))
    return [things[i : i + size] for i in range(0, len(things), size)]


def _begin(work: Callable[[Any], Any], begin: Callable[[], None] | None) -> None:
    global _work
    end_with_parent()
    _work = work
    if begin is not None:
        begin()


def _several(things: Sequence[Any]) -> list[Any]:
    assert _work is not None
    return [_work(thing) for thing in things]
