"""What a rendering process does: load a scene, then its views one after the other."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from queue import SimpleQueue
from typing import Any

from data.render.recipe import Recipe
from data.render.sources import Source
from data.render.tracer import Tracer
from data.render.variant import Variant, activate
from data.render.views import ViewWork, render_view


@dataclass(frozen=True)
class Task:
    """Views of one scene."""

    source: Source
    works: list[ViewWork]


class _Process:
    """What a process was told when it started."""

    reports: Any = None
    renderer: str = ""


def start(variant: Variant, threads: int, reports: Any, parent: int) -> None:
    """Prepare a process: choose the renderer's variant and its threads, and end when the parent ends."""
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()
    activate(variant, threads)
    _Process.reports = reports
    _Process.renderer = _renderer(variant)


def render_task(task: Task) -> None:
    """Render the views of a task, and report samples as they are done.

    Raises:
        ValueError: The scene cannot be made or rendered; the message names it.
        OSError: A file cannot be written.
    """
    _report(0, f"{task.source.name}: preparing")
    recipe = task.works[0].recipe
    try:
        spec = task.source.build()
        tracer = Tracer(spec, chunk=recipe.chunk, max_depth=recipe.max_depth)
        for work in task.works:
            label = f"{work.scene}, view {work.view}"
            render_view(work, tracer, _Process.renderer, partial(_report, label=label))
    except RuntimeError as error:
        raise _failed(task.source, error) from error


def render_alone(task: Task, variant: Variant, threads: int) -> int:
    """Render the views of a task in a process that no other of this machine waits for.

    Returns:
        The samples that were traced.

    Raises:
        ValueError: The scene cannot be made or rendered; the message names it.
        OSError: A file cannot be written.
    """
    activate(variant, threads)
    reports: SimpleQueue[tuple[int, str]] = SimpleQueue()
    _Process.reports = reports
    _Process.renderer = _renderer(variant)
    render_task(task)
    return sum(reports.get()[0] for _ in range(reports.qsize()))


def speed_of(source: Source, recipe: Recipe) -> float:
    """Return the samples per second of a reference, measured on the second pass; the first one compiles.

    Raises:
        ValueError: The scene cannot be made or rendered; the message names it.
    """
    try:
        return _speed(source, recipe)
    except RuntimeError as error:
        raise _failed(source, error) from error


def _failed(source: Source, error: RuntimeError) -> ValueError:
    return ValueError(f"scene {source.name!r}: the renderer failed: {' '.join(str(error).split())[:600]}")


def _speed(source: Source, recipe: Recipe) -> float:
    tracer = Tracer(source.build(), chunk=recipe.chunk, max_depth=recipe.max_depth)
    spp = max(1, min(recipe.reference_spp, recipe.chunk // recipe.pixels))
    seconds = 0.0
    for seed in range(2):
        began = time.perf_counter()
        for _ in tracer.trace(0, spp, seed, recipe.reference_names):
            pass
        seconds = time.perf_counter() - began
    return spp * recipe.pixels / seconds


def _report(count: int, label: str) -> None:
    """Tell the parent what was done."""
    _Process.reports.put((count, label))


def _renderer(variant: Variant) -> str:
    return f"Mitsuba {version('mitsuba')} ({variant.name})"


def _follow(parent: int) -> None:
    """End this process when its parent is gone, so that a killed command leaves nothing that renders."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
