"""Measure cases one after another, each in a fresh process."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from trainer.benchmarking.cases import Case, Effort, Method, Outcome
from trainer.benchmarking.process import Measuring, MeasuringError, Tell

LEAST = 3
"""Calls that are measured however long they take."""

BLOCK_S = 0.5
"""Short calls are measured so many seconds at once, between which progress is told."""

Advance = Callable[[float], None]


@dataclass
class Exports:
    """Exported forms of methods, made once, in a temporary folder.

    Attributes:
        folder: Where to.
        root: Folder with the packages; None: these here.
    """

    folder: Path
    root: Path | None = None
    _made: dict[tuple[Method, str], Path | MeasuringError] = field(default_factory=dict)

    def file(self, case: Case, tell: Tell) -> Path | None:
        """Return the file that stands for the model of a case, None where the model itself is measured.

        Raises:
            MeasuringError: It cannot be exported.
        """
        if case.mode not in ("onnx", "torchscript") or case.method.format or case.kind == "training":
            return None
        key = (case.method, case.mode)
        if key not in self._made:
            self._made[key] = self._export(*key, tell)
        made = self._made[key]
        if isinstance(made, MeasuringError):
            raise made
        return made

    def _export(self, method: Method, format: str, tell: Tell) -> Path | MeasuringError:
        suffix = {"onnx": ".onnx", "torchscript": ".ts"}[format]
        path = self.folder / f"{hashlib.sha256(method.label.encode()).hexdigest()[:16]}{suffix}"
        with Measuring(self.root, tell) as process:
            try:
                process.export(method, format, path)
            except MeasuringError as error:
                return error
        return path


@contextmanager
def exports(root: Path | None = None) -> Iterator[Exports]:
    """Yield a place for exported files that is gone afterwards."""
    with TemporaryDirectory(prefix="penumbra-benchmark-") as folder:
        yield Exports(Path(folder), root)


@dataclass(frozen=True)
class Watcher:
    """Whom to tell how far it is.

    Attributes:
        tell: Called with what is being done.
        advance: Called with the share of the present case by which the work went on.
    """

    tell: Tell = lambda stage: None
    advance: Advance = lambda share: None


def measure(
    case: Case,
    effort: Effort,
    made: Exports,
    watcher: Watcher = Watcher(),
    timeout: float | None = None,
) -> Outcome:
    """Return the figures of a case, or why there are none.

    Args:
        case: What to measure.
        effort: How long.
        made: Exported files, where the case needs one.
        watcher: Whom to tell.
        timeout: Seconds that loading, or any one call, may take; None: as long as it wants.
    """
    try:
        file = made.file(case, watcher.tell)
        with Measuring(made.root, watcher.tell, timeout) as process:
            ready = process.prepare(case, effort.warmup, file)
            watcher.tell("measuring")
            seconds = _repeated(process, effort, watcher)
            end = process.finish()
    except MeasuringError as error:
        return Outcome(case, str(error))
    case = replace(case, mode=ready.pop("mode"))
    return Outcome(case, None, tuple(seconds), **ready, **end)


def _repeated(process: Measuring, effort: Effort, watcher: Watcher) -> list[float]:
    seconds: list[float] = []
    start = time.monotonic()
    while len(seconds) < effort.repeat:
        left = effort.seconds - (time.monotonic() - start)
        if len(seconds) >= LEAST and left <= 0:
            break
        wanted = int(min(BLOCK_S, left) / max(seconds[-1], 1e-6)) if seconds else 1
        calls = min(max(wanted, 1), effort.repeat - len(seconds))
        seconds += process.times(calls)
        watcher.advance(calls / effort.repeat)
    return seconds
