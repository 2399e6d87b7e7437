"""Processes that cut scenes side by side."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import threading
import types
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from multiprocessing.connection import wait as wait_for
from typing import Any


def in_processes(
    function: Callable[..., None], jobs: list[tuple[Any, ...]], processes: int, report: Callable[[], None]
) -> None:
    """Call a function of a module with each tuple of arguments, in several processes.

    Args:
        function: What to call.
        jobs: Arguments of each call.
        processes: Number of processes.
        report: Called now and then while they work.

    Raises:
        Exception: What the first failing call raised; calls that have not begun are left out.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=end_with_parent) as pool:
        with _without_script():
            futures = [pool.submit(function, *job) for job in jobs]
        try:
            pending = set(futures)
            while pending:
                finished, pending = wait(pending, timeout=0.5, return_when=FIRST_EXCEPTION)
                for future in finished:
                    future.result()
                report()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


@contextlib.contextmanager
def _without_script() -> Iterator[None]:
    """Keep the processes that start now from importing the running script, of which they need nothing.

    A script without a main guard would run again in each of them, and wait for what its parent is making.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def end_with_parent() -> None:
    """End this process when the process that started it is gone, however that happened."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(sentinel: int) -> None:
        wait_for([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()
