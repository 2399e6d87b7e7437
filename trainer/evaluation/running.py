"""Methods one after the other, each in a process of its own, and scores of what they made beside them.

Rows are kept as they come (`rows.jsonl`), so that an interrupted evaluation goes on where it was; the
scores of a frame are taken while the next ones are denoised.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from data.jobs import Runner, elsewhere
from trainer.evaluation.keeping import Kept, Row, identity_of_rows
from trainer.evaluation.plan import INPUT, NOISY, Method, Setting
from trainer.evaluation.scores import question_of
from trainer.evaluation.scoring import PROCESSES, Scorers
from trainer.evaluation.spreading import Told, spread
from trainer.evaluation.worker import Task, facts_of, serve
from trainer.loading import resolve
from trainer.progress import FrameProgress


@dataclass
class Outcome:
    """What came of one method.

    Attributes:
        method: The method.
        facts: What the worker knows about it: class, parameters, inputs.
        rows: Frame → row, with metrics where they could be taken.
        reason: Why it is not among the results, None where it is.
        crashed: The process died.
    """

    method: Method
    facts: dict[str, Any] = field(default_factory=dict)
    rows: dict[str, Row] = field(default_factory=dict)
    reason: str | None = None
    crashed: bool = False

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


class Evaluation:
    """Runs methods and scores.

    Args:
        setting: How.
        progress: Shows how far it is; counts a frame of a method when it is scored.
    """

    def __init__(self, setting: Setting, progress: FrameProgress) -> None:
        self.setting, self.progress = setting, progress
        self._kept = Kept(setting.folder)
        self._trouble: OSError | None = None

    def run(self, methods: Sequence[Method]) -> list[Outcome]:
        """Return what came of the input and of every method, in order.

        Raises:
            OSError: A result cannot be written.
            KeyboardInterrupt: What was done so far stays.
        """
        noisy = Method(INPUT, NOISY, folder=INPUT)
        if runner := elsewhere():
            found = self._spread([noisy], runner)
            self._judge_by(found[0])
            return found + self._spread(methods, runner)
        with Scorers(self.setting.jobs) as scorers:
            found = [self._one(noisy, scorers)]
            self._judge_by(found[0])
            found += [self._one(method, scorers) for method in methods]
        if self._trouble is not None:
            raise self._trouble
        return found

    def _judge_by(self, noisy: Outcome) -> None:
        """Judge all methods at the exposures of the input: one that fails at a frame may choose another."""
        exposures = {name: row["exposure"] for name, row in noisy.rows.items() if "exposure" in row}
        self.setting = replace(self.setting, exposures=exposures)

    def _spread(self, methods: Sequence[Method], runner: Runner) -> list[Outcome]:
        """Have clips denoised and scored elsewhere, but those that are there."""
        found = {method.label: Outcome(method) for method in methods}
        for outcome in found.values():
            self._prepare(outcome)

        def take(method: Method, told: Told) -> None:
            outcome = found[method.label]
            for message in told:
                outcome.reason = message.get("reason", outcome.reason)
                if "say" in message:
                    self.progress.say(f"{method.label}: {message['say']}", message["kind"])
                if "row" in message:
                    row = self._row(outcome, message["row"])
                    outcome.rows[row["name"]] = row
                    self._kept.add(row)
                    self.progress.advance(f"{method.label} {row['name']}")

        wanted = {outcome.method: set(outcome.rows) for outcome in found.values() if not outcome.reason}
        for label, reason in spread(wanted, self.setting, runner, take).items():
            found[label].crashed, found[label].reason = True, reason
        return list(found.values())

    def _row(self, outcome: Outcome, told: Row) -> Row:
        identity = identity_of_rows(outcome.facts, self.setting)
        return {"method": outcome.method.label, "identity": identity, **told}

    def _prepare(self, outcome: Outcome) -> None:
        """Load a method here to know what it is, and which of its rows are there."""
        method = outcome.method
        try:
            outcome.facts = facts_of(resolve(method.model, options=method.options))
        except (ValueError, OSError) as error:
            outcome.reason = (str(error).splitlines() or [repr(error)])[0]
            return
        outcome.rows = self._kept.of(method, identity_of_rows(outcome.facts, self.setting))
        for name in outcome.rows:
            self.progress.advance(f"{method.label} {name}")

    def _one(self, method: Method, scorers: Scorers) -> Outcome:
        outcome = Outcome(method)
        with self._worker(method, outcome) as worker:
            for message in worker:
                if self._trouble is not None:
                    raise self._trouble
                if "facts" in message:
                    outcome.facts = message["facts"]
                    outcome.rows = self._kept.of(method, identity_of_rows(outcome.facts, self.setting))
                    worker.answer(list(outcome.rows))
                    for name in outcome.rows:
                        self.progress.advance(f"{method.label} {name}")
                else:
                    self._take(message, outcome, scorers)
        return outcome

    def _take(self, message: dict[str, Any], outcome: Outcome, scorers: Scorers) -> None:
        label = outcome.method.label
        if "say" in message:
            self.progress.say(f"{label}: {message['say']}", message["kind"])
        elif "within" in message:
            self.progress.within(message["within"])
        elif "reason" in message:
            outcome.reason = message["reason"]
        elif "row" in message:
            row = self._row(outcome, message["row"])
            outcome.rows[row["name"]] = row
            if row["status"] == "failed":
                self._kept.add(row)
                self.progress.advance(f"{label} {row['name']}")
            else:
                self._score(row, outcome.method, scorers)

    def _score(self, row: Row, method: Method, scorers: Scorers) -> None:
        """Have a frame scored; its row is kept when that is done."""
        question = question_of(self.setting, method, row)

        def finished(answer: Future[dict[str, float]]) -> None:
            if answer.cancelled():
                return
            error = answer.exception()
            if error is None:
                row.update(answer.result())
            else:
                row.update(status="failed", reason=f"not scored: {error}")
            try:
                self._kept.add(row)
            except OSError as error:  # told by the thread that runs the methods
                self._trouble = error
            self.progress.advance(f"{method.label} {row['name']}")

        scorers.ask(question, finished)

    @contextmanager
    def _worker(self, method: Method, outcome: Outcome) -> Iterator[_Worker]:
        """Yield a worker; why it ended, unless it was done, is said in `outcome`."""
        setting, task = self.setting, Task.of(method, self.setting)
        path = setting.folder / "logs" / f"{method.folder}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        with _Worker(task, path) as worker:
            yield worker
            code = worker.wait()
        if code and outcome.reason is None:
            outcome.crashed, outcome.reason = True, _reason(code, path)


class _Worker:
    """A process that denoises; iterates over what it tells."""

    def __init__(self, task: Task, log: Path) -> None:
        self._link, end = PROCESSES.Pipe()
        given = (task, end, str(log), dict(os.environ))
        self.process = PROCESSES.Process(target=serve, args=given)
        self.process.start()
        end.close()  # so that its death ends the stream
        self._heard = os.fdopen(os.dup(self._link.fileno()))

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *exception: object) -> None:
        """End the process, if it still runs."""
        self.process.terminate()
        self.process.join()
        self._heard.close()
        self._link.close()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        with suppress(ConnectionResetError):
            for line in self._heard:
                with suppress(json.JSONDecodeError):  # cut off by its death
                    yield json.loads(line)

    def answer(self, value: Any) -> None:
        """Send a line."""
        with suppress(OSError):  # it is dead, which its status tells
            os.write(self._link.fileno(), json.dumps(value).encode() + b"\n")

    def wait(self) -> int:
        """Wait for its end and return its exit code, negative for a signal."""
        self.process.join()
        return self.process.exitcode or 0


def _reason(code: int, log: Path) -> str:
    """Return why a process died, in one line."""
    if code < 0:
        import signal

        name = signal.Signals(-code).name
        hint = "; perhaps for want of memory" if name == "SIGKILL" else ""
        return f"its process ended with {name}{hint}"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return f"its process ended with {code}: {lines[-1][:200] if lines else 'it said nothing'}"
