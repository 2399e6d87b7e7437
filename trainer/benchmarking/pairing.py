"""Two methods, or one method in two revisions, against each other in turns.

Both run at the same time in processes of their own and compute in turns, A B B A, so that whatever else the
machine does meets both alike. Two processes of one program differ by a lasting percent or so, since memory
lies elsewhere in each; turns cannot remove that, and a test that took all turns for independent would call it
a difference. Each comparison therefore starts several pairs of processes. The median over a pair's rounds of

    (log B1 + log B2) / 2 - (log A1 + log A2) / 2

is one observation, and the interval is Student's over these observations.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trainer.benchmarking.cases import Case, Effort, Outcome
from trainer.benchmarking.measuring import Exports, Watcher
from trainer.benchmarking.process import Measuring, MeasuringError

BLOCK_S = 0.1
"""Calls shorter than this are measured several at a time, whose median counts."""

_STUDENT = {
    2: 4.3027, 3: 3.1824, 4: 2.7764, 5: 2.5706, 6: 2.4469, 7: 2.3646, 8: 2.3060, 9: 2.2622, 10: 2.2281,
    11: 2.2010, 12: 2.1788, 13: 2.1604, 14: 2.1448, 15: 2.1314, 16: 2.1199, 17: 2.1098, 18: 2.1009,
    19: 2.0930,
}  # fmt: skip
"""Degrees of freedom → what 2.5 % of Student's distribution lie above."""

FEWEST, MOST = 3, 20
"""Pairs of processes."""


@dataclass(frozen=True)
class Contestant:
    """One side of a comparison.

    Attributes:
        name: How it is called: the model, or the revision.
        case: What it runs.
        made: Exported files, and where its packages are.
    """

    name: str
    case: Case
    made: Exports


@dataclass(frozen=True)
class Comparison:
    """What came of it.

    Attributes:
        names: Of A and B.
        sides: Figures of A and B, over all of their processes; where one failed, its reason.
        ratios: Time of B divided by that of A, one per pair of processes.
    """

    names: tuple[str, str]
    sides: tuple[Outcome, Outcome]
    ratios: tuple[float, ...] = ()

    @property
    def done(self) -> bool:
        """Whether there is a ratio with an interval."""
        return all(side.done for side in self.sides) and len(self.ratios) >= FEWEST

    @property
    def ratio(self) -> float:
        """Time of B divided by the time of A."""
        return math.exp(statistics.fmean(map(math.log, self.ratios)))

    @property
    def interval(self) -> tuple[float, float]:
        """Where the ratio lies with 95 % confidence."""
        return student_interval(self.ratios)

    @property
    def significant(self) -> bool:
        """Whether the interval leaves out 1."""
        low, high = self.interval
        return not low <= 1 <= high

    def row(self) -> dict[str, Any]:
        """Return all of it for a file."""
        row: dict[str, Any] = {"names": list(self.names), "sides": [side.row() for side in self.sides]}
        if self.done:
            row |= {"ratio": self.ratio, "interval": list(self.interval), "significant": self.significant}
        return row | {"ratios": list(self.ratios)}


def student_interval(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of the geometric mean of independent ratios, at least three."""
    logs = [math.log(ratio) for ratio in ratios]
    mean = statistics.fmean(logs)
    reach = _STUDENT[len(logs) - 1] * statistics.stdev(logs) / math.sqrt(len(logs))
    return math.exp(mean - reach), math.exp(mean + reach)


class _Side:
    """A contestant's process in one pair, and what all of its processes have measured."""

    def __init__(self, contestant: Contestant) -> None:
        self.contestant = contestant
        self.seconds: list[float] = []
        self.facts: list[dict[str, Any]] = []
        self.calls = 1
        self._ready: dict[str, Any] = {}

    def prepare(self, process: Measuring, warmup: int, file: Path | None) -> None:
        self._ready = process.prepare(self.contestant.case, warmup, file)
        first = process.times(1)[0]
        self.calls = max(1, math.ceil(BLOCK_S / max(first, 1e-6)))

    def turn(self, process: Measuring) -> float:
        """Return the seconds of a call."""
        seconds = process.times(self.calls)
        self.seconds += seconds
        return statistics.median(seconds)

    def finish(self, process: Measuring) -> None:
        self.facts.append(self._ready | process.finish())

    def outcome(self) -> Outcome:
        facts = self.facts[0] | {
            name: statistics.median(fact[name] for fact in self.facts)
            for name in ("first_seconds", "peak_bytes", "others")
        }
        case = replace(self.contestant.case, mode=facts.pop("mode"))
        return Outcome(case, None, tuple(self.seconds), **facts)


def compare(a: Contestant, b: Contestant, effort: Effort, processes: int, watcher: Watcher) -> Comparison:
    """Measure two contestants in turns.

    Args:
        a: One; the ratio is relative to it.
        b: The other.
        effort: Its `repeat` is the number of rounds A B B A of each pair of processes, and its `seconds`
            bound the comparison.
        processes: Pairs of processes, at least three.
        watcher: Whom to tell.
    """
    sides = (_Side(a), _Side(b))
    ratios: list[float] = []
    for number in range(processes):
        # Who is loaded first changes from pair to pair, too.
        order = sides if number % 2 == 0 else sides[::-1]
        share = replace(effort, seconds=effort.seconds / processes)
        try:
            logs = _pair(order, share, watcher, 1 / processes)
        except _SideError as failure:
            found = [
                Outcome(s.contestant.case, failure.reason if s is failure.side else "not without the other")
                for s in sides
            ]
            return Comparison((a.name, b.name), (found[0], found[1]))
        ratios.append(math.exp(logs if order is sides else -logs))
    return Comparison((a.name, b.name), (sides[0].outcome(), sides[1].outcome()), tuple(ratios))


class _SideError(Exception):
    def __init__(self, side: _Side, reason: str) -> None:
        super().__init__(reason)
        self.side, self.reason = side, reason


def _pair(sides: tuple[_Side, ...], effort: Effort, watcher: Watcher, weight: float) -> float:
    """Return the median over rounds of the logarithm of the second's time divided by the first's."""
    one, other = sides
    running: list[tuple[_Side, Measuring]] = []
    side = one
    try:
        for side in sides:
            made = side.contestant.made
            file = made.file(side.contestant.case, watcher.tell)
            running.append((side, Measuring(made.root, watcher.tell)))
            side.prepare(running[-1][1], effort.warmup, file)
        watcher.tell("measuring in turns")
        logs: list[float] = []
        start = time.monotonic()
        while len(logs) < effort.repeat and (not logs or time.monotonic() - start < effort.seconds):
            total = 0.0
            for index in (0, 1, 1, 0):
                side, process = running[index]
                total += (0.5 if side is other else -0.5) * math.log(side.turn(process))
            logs.append(total)
            watcher.advance(weight / effort.repeat)
        for side, process in running:
            side.finish(process)
        return statistics.median(logs)
    except MeasuringError as error:
        raise _SideError(side, str(error)) from error
    finally:
        for _, process in running:
            process.close()
