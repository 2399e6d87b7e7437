"""Methods on clips as independent jobs, for `trainer submit evaluate`."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from data.jobs import Job, Runner
from trainer.evaluation.plan import Method, Setting, clips_of
from trainer.evaluation.scores import question_of, score
from trainer.evaluation.worker import Task, Worker

Told = list[dict[str, Any]]
"""What a worker tells, rows with their metrics."""


def spread(
    methods: Mapping[Method, Collection[str]],
    setting: Setting,
    runner: Runner,
    take: Callable[[Method, Told], None],
) -> dict[str, str]:
    """Denoise and score all clips with all methods elsewhere; results are taken as they come.

    Args:
        methods: Each method, and the names of the frames that need not be made again.
        setting: How they are run; its folder must be seen by all machines.
        runner: Runs jobs.
        take: Called with a method and what was told of one of its clips.

    Returns:
        Label → why jobs of a method failed otherwise than by what they told.
    """
    clips, _ = clips_of(setting.root, setting.split or "all")
    left: dict[str, Method] = {}
    jobs = []
    for method, there in methods.items():
        for number, clip in enumerate(clips):
            if all(item.name in there for item in clip.items):
                continue
            task = replace(Task.of(method, setting), only=tuple(item.name for item in clip.items))
            name = f"{method.label}, clip {number + 1} of {len(clips)}"
            left[name] = method
            jobs.append(Job(name, run_task, (task, method, setting), (setting.folder.resolve(),)))

    def done(job: Job | None, told: Told | None) -> None:
        if job is not None and told is not None:
            take(left.pop(job.name), told)

    try:
        runner(jobs, done)
    except ValueError as error:  # all jobs were tried; names those that failed
        return {method.label: str(error) for method in left.values()}
    return {}


def run_task(task: Task, method: Method, setting: Setting) -> Told:
    """Do a task in this process and return what was told of it."""
    out = io.StringIO()
    worker = Worker(task, io.StringIO("[]"), out)
    try:
        worker.run()
    except (ValueError, OSError) as error:
        worker.tell(reason=(str(error).splitlines() or [repr(error)])[0])
    told: Told = [json.loads(line) for line in out.getvalue().splitlines()]
    for message in told:
        row = message.get("row")
        if row is not None and row["status"] != "failed":
            row.update(score(question_of(setting, method, row)))
    return told
