"""Processes that render: tasks, what they report, and their end."""

from __future__ import annotations

import multiprocessing
import os
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from data.jobs import Job, Runner, elsewhere
from data.render.recipe import Recipe
from data.render.sources import Source
from data.render.variant import Variant, activate
from data.render.views import WORK, ViewWork
from data.render.worker import Task, render_alone, render_task, speed_of, start

Report = Callable[[int, str], None]

HEARTBEAT = 5.0
"""Seconds without news after which a caller is told that the work still goes on."""


def work_on(tasks: list[Task], processes: int, variant: Variant, threads: int, report: Report) -> None:
    """Run tasks in processes of their own; none is left when this returns or raises.

    Args:
        tasks: What is to be done.
        processes: How many at once.
        variant: The renderer's variant.
        threads: Threads of each process.
        report: Called with the samples done since the last call, and a label.

    Raises:
        ValueError: A scene cannot be rendered, or a process died.
        OSError: A file cannot be written.
    """
    if runner := elsewhere():
        _work_elsewhere(runner, tasks, variant, report)
        return
    context = multiprocessing.get_context("spawn")  # the renderer keeps threads, which no fork survives
    reports = context.Queue()
    pool = ProcessPoolExecutor(
        min(processes, len(tasks)),
        mp_context=context,
        initializer=start,
        initargs=(variant, threads, reports, os.getpid()),
    )
    try:
        pending = [pool.submit(render_task, task) for task in tasks]
        for count, label in _reports(reports, pending):
            report(count, label)
        pool.shutdown()
    except BaseException:
        _end(pool)
        raise


def _work_elsewhere(runner: Runner, tasks: list[Task], variant: Variant, report: Report) -> None:
    jobs = [
        Job(
            f"scene {task.source.name}, views {task.works[0].view} to {task.works[-1].view}",
            render_alone,
            (task, variant, runner.cores),
            (task.works[0].root / WORK,),
        )
        for task in tasks
    ]
    label = "starting"

    def done(job: Job | None, samples: int | None) -> None:
        nonlocal label
        label = job.name if job is not None else label
        report(samples or 0, label)

    runner(jobs, done)


def tasks_of(busy: Sequence[tuple[Source, list[ViewWork]]], processes: int) -> Iterator[Task]:
    """Yield tasks: whole scenes where there are enough, so that each is loaded once; else parts of them.

    Args:
        busy: Scenes and the views of them that are not finished, at least one each.
        processes: Number of processes.
    """
    parts = -(-processes // max(len(busy), 1))
    for source, works in busy:
        count = min(parts, len(works))
        for part in range(count):
            yield Task(source, works[part * len(works) // count : (part + 1) * len(works) // count])


def measure_speed(source: Source, recipe: Recipe, variant: Variant, threads: int) -> float:
    """Return the samples per second of one process on a scene, after what it takes to load the scene.

    Raises:
        ValueError: The scene cannot be rendered.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        1, mp_context=context, initializer=activate, initargs=(variant, threads)
    ) as pool:
        try:
            return pool.submit(speed_of, source, recipe).result()
        except BrokenProcessPool:
            raise ValueError(
                f"the process that rendered scene {source.name!r} died (out of memory, or the renderer "
                "aborted); give --memory, or --variant scalar"
            ) from None


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop the processes of a pool without waiting for the passes that they are at."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def _reports(reports: Any, pending: list[Future[None]]) -> Iterator[tuple[int, str]]:
    """Yield what the processes report until all tasks are done; raises the first error of a task.

    Where nothing is heard for a while, no samples and the last label are yielded.
    """
    left, label, heard = set(pending), "starting", time.monotonic()
    yield 0, label
    while left:
        try:
            count, label = reports.get(timeout=0.2)
            heard = time.monotonic()
            yield count, label
            continue
        except queue.Empty:
            pass
        if time.monotonic() - heard > HEARTBEAT:
            heard = time.monotonic()
            yield 0, label
        for future in [f for f in left if f.done()]:
            left.remove(future)
            try:
                future.result()
            except BrokenProcessPool:
                raise ValueError(
                    "a rendering process died (out of memory, or the renderer aborted); finished work is "
                    "kept: run the same command again, with fewer --processes or --variant scalar"
                ) from None
    while True:
        try:
            yield reports.get_nowait()
        except queue.Empty:
            return
