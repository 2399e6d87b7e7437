"""Methods one after the other, each in a process of its own, and scores of what they made beside them.

Rows are kept as they come (`rows.jsonl`), so that an interrupted evaluation goes on where it was; the
scores of a frame are taken while the next ones are denoised.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from trainer.evaluation.plan import INPUT, NOISY, Method
from trainer.evaluation.scores import Question, score
from trainer.evaluation.worker import Task
from trainer.export.description import DISTRIBUTION, installed_version
from trainer.progress import FrameProgress

ROWS = "rows.jsonl"
Row = dict[str, Any]


@dataclass
class Outcome:
    """What came of one method.

    Attributes:
        method: The method.
        facts: What the worker knows about it: class, parameters, inputs.
        rows: Frame → row, with metrics where they could be taken.
        reason: Why it is not among the results, None where it is.
        crashed: The process died.
        seconds: Spent by its process in all.
    """

    method: Method
    facts: dict[str, Any] = field(default_factory=dict)
    rows: dict[str, Row] = field(default_factory=dict)
    reason: str | None = None
    crashed: bool = False
    seconds: float = 0.0

    @property
    def status(self) -> str:
        """`done`, `skipped` (no frame could be denoised), or `failed` (it broke on its way)."""
        good = [row for row in self.rows.values() if row["status"] != "failed"]
        if self.crashed or (self.reason and good):
            return "failed"
        return "done" if good else "skipped"

    def told(self) -> str | None:
        """Return what a table says about what is missing, None where nothing is."""
        if self.reason:
            return self.reason
        failed = [row for row in self.rows.values() if row["status"] != "done"]
        if not failed:
            return None
        first = failed[0]["reason"]
        return (
            first if len(failed) == len(self.rows) else f"{len(failed)} of {len(self.rows)} frames: {first}"
        )


@dataclass(frozen=True)
class Setting:
    """How everything is run.

    Attributes:
        root: The data set, as the user named it.
        split: Which part.
        data: What tells these frames from others: the hash of a manifest, or names.
        names: Frames in order, and for each that of the preceding one of its sequence.
        folder: Of the evaluation.
        metrics: Names of the metrics.
        device: Where methods run.
        memory: Bytes that a call of a method may take.
        jobs: Processes that take scores.
    """

    root: str
    split: str | None
    data: str
    names: dict[str, str | None]
    folder: Path
    metrics: tuple[str, ...]
    device: str = "cpu"
    memory: int = 2 * 1024**3
    jobs: int = 1


class Evaluation:
    """Runs methods and scores.

    Args:
        setting: How.
        progress: Shows how far it is; counts a frame of a method when it is scored.
    """

    def __init__(self, setting: Setting, progress: FrameProgress) -> None:
        self.setting, self.progress = setting, progress
        self.images = setting.folder / "images"
        self._kept = _Kept(setting.folder / ROWS)

    def run(self, methods: Sequence[Method]) -> list[Outcome]:
        """Return what came of the input and of every method, in order.

        Raises:
            OSError: A result cannot be written.
            KeyboardInterrupt: What was done so far stays.
        """
        noisy = Method(INPUT, NOISY, folder=INPUT)
        with ProcessPoolExecutor(self.setting.jobs, get_context("spawn"), initializer=_quiet) as pool:
            found = []
            for method in (noisy, *methods):
                found.append(self._one(method, pool))
        return found

    def _one(self, method: Method, pool: ProcessPoolExecutor) -> Outcome:
        outcome = Outcome(method)
        began = time.monotonic()
        with self._worker(method, outcome) as worker:
            for message in worker:
                if "facts" in message:
                    outcome.facts = message["facts"]
                    outcome.rows = self._kept.of(method.label, self._identity(outcome))
                    worker.answer(list(outcome.rows))
                    for name in outcome.rows:
                        self.progress.advance(f"{method.label} {name}")
                else:
                    self._take(message, outcome, pool)
        outcome.seconds = time.monotonic() - began
        return outcome

    def _identity(self, outcome: Outcome) -> str:
        """Return what rows must have been made by to be taken over."""
        facts, setting = outcome.facts, self.setting
        made = (facts["class"], facts["options"], facts["sha256"], installed_version(DISTRIBUTION))
        return json.dumps([*made, setting.data, *sorted(setting.metrics)])

    def _take(self, message: dict[str, Any], outcome: Outcome, pool: ProcessPoolExecutor) -> None:
        label = outcome.method.label
        if "say" in message:
            self.progress.say(f"{label}: {message['say']}", message["kind"])
        elif "within" in message:
            self.progress.within(message["within"])
        elif "reason" in message:
            outcome.reason = message["reason"]
        elif "row" in message:
            row = {"method": label, "identity": self._identity(outcome), **message["row"]}
            outcome.rows[row["name"]] = row
            if row["status"] == "failed":
                self._kept.add(row)
                self.progress.advance(f"{label} {row['name']}")
            else:
                self._score(row, outcome.method, pool)

    def _score(self, row: Row, method: Method, pool: ProcessPoolExecutor) -> None:
        """Have a frame scored; its row is kept when that is done."""
        question = Question(
            str(self.images),
            method.folder,
            row["name"],
            self.setting.names[row["name"]],
            row["exposure"],
            self.setting.metrics,
        )

        def finished(answer: Future[dict[str, float]]) -> None:
            if answer.cancelled():
                return
            error = answer.exception()
            if error is None:
                row.update(answer.result())
            else:
                row.update(status="failed", reason=f"not scored: {error}")
            self._kept.add(row)
            self.progress.advance(f"{method.label} {row['name']}")

        pool.submit(score, question).add_done_callback(finished)

    @contextmanager
    def _worker(self, method: Method, outcome: Outcome) -> Iterator[_Worker]:
        """Yield a worker; why it ended, unless it was done, is said in `outcome`."""
        setting = self.setting
        task = Task(
            method.model, method.options, setting.root, setting.split, str(self.images), method.folder,
            setting.device, setting.memory,
        )  # fmt: skip
        path = setting.folder / "logs" / f"{method.folder}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        with _Worker(task, path) as worker:
            yield worker
            code = worker.process.wait()
        if code and outcome.reason is None:
            outcome.crashed, outcome.reason = True, _reason(code, path)


class _Worker:
    """A process that denoises; iterates over what it tells."""

    def __init__(self, task: Task, log: Path) -> None:
        with log.open("ab") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "trainer.evaluation.worker"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file, text=True,
            )  # fmt: skip
        self.answer(asdict(task))

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *exception: object) -> None:
        """End the process, if it still runs."""
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            with suppress(OSError):
                if stream is not None:
                    stream.close()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for line in self.process.stdout or ():
            with suppress(json.JSONDecodeError):  # cut off by its death
                yield json.loads(line)

    def answer(self, value: Any) -> None:
        """Send a line."""
        with suppress(OSError):  # it is dead, which its status tells
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(value) + "\n")
                self.process.stdin.flush()


def _reason(code: int, log: Path) -> str:
    """Return why a process died, in one line."""
    if code < 0:
        import signal

        name = signal.Signals(-code).name
        hint = "; perhaps for want of memory" if name == "SIGKILL" else ""
        return f"its process ended with {name}{hint}"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return f"its process ended with {code}: {lines[-1][:200] if lines else 'it said nothing'}"


def _quiet() -> None:
    """Let processes that take scores give way to the methods, and end silently with Ctrl-C."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(5)


class _Kept:
    """The rows on disk, one JSON object a line; a line that was cut off by a kill is left out."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._rows: list[Row] = []
        if path.is_file():
            whole = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
            self._rows = [json.loads(line) for line in whole]
            path.write_text("".join(whole))

    def of(self, label: str, identity: str) -> dict[str, Row]:
        """Return the rows of a method that need not be made again: made as now, and not failed."""
        made = (row for row in self._rows if (row["method"], row["identity"]) == (label, identity))
        return {row["name"]: row for row in made if row["status"] != "failed"}

    def add(self, row: Row) -> None:
        """Keep a row."""
        with self._lock, self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")
