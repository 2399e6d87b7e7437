"""Processes that take scores beside the methods, and on all cores when these are done."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from types import TracebackType
from typing import Any

from trainer.evaluation.scores import Question, score

PROCESSES: Any = get_context("forkserver" if sys.platform == "linux" else "spawn")
"""How processes are started: by a copy of one that has PyTorch loaded already, which takes seconds."""
LOADED = ("trainer.evaluation.worker", "trainer.evaluation.scores")
"""Modules that such a process has loaded."""

Done = Callable[[Future[dict[str, float]]], None]


class Scorers:
    """Answers questions in other processes, some at a time.

    Args:
        jobs: How many at a time while methods need the cores.
    """

    def __init__(self, jobs: int) -> None:
        self.cores = max(
            jobs, len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
        )
        self._most, self._running = jobs, 0
        self._waiting: deque[tuple[Question, Done]] = deque()
        self._changed = threading.Condition()
        PROCESSES.set_forkserver_preload([*LOADED])
        self._pool = self._started()

    def __enter__(self) -> Scorers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for all answers on all cores; after an error drop the questions that wait."""
        with self._changed:
            self._most = self.cores
            if kind is not None:
                self._waiting.clear()
            self._begin()
            while self._running or self._waiting:
                self._changed.wait()
        self._pool.shutdown(cancel_futures=True)

    def ask(self, question: Question, done: Done) -> None:
        """Have a frame scored; `done` is called with the answer, on another thread."""
        with self._changed:
            self._waiting.append((question, done))
            self._begin()

    def _begin(self) -> None:
        while self._waiting and self._running < self._most:
            question, done = self._waiting.popleft()
            self._running += 1
            self._submitted(question).add_done_callback(partial(self._end, done))

    def _submitted(self, question: Question) -> Future[dict[str, float]]:
        try:
            return self._pool.submit(score, question)
        except BrokenExecutor:  # one was killed, with which a pool ends; the others go on in a new one
            self._pool = self._started()
            return self._pool.submit(score, question)

    def _started(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self.cores, PROCESSES, initializer=quiet)

    def _end(self, done: Done, answer: Future[dict[str, float]]) -> None:
        try:
            done(answer)
        finally:
            with self._changed:
                self._running -= 1
                self._begin()
                self._changed.notify_all()


def quiet() -> None:
    """Let a process give way to the methods, and end silently with Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(5)
