"""Times of two contestants, taken in turns so that both meet the same load of the machine."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Row = dict[str, Any]
"""`name`, `value`, `unit`, and where there is a target `target` (text) and `meets`."""


def medians(calls: Mapping[str, Callable[[], object]], repeats: Mapping[str, int]) -> dict[str, float]:
    """Return the median wall time in seconds of every call.

    Args:
        calls: What to run; each is run once beforehand, unmeasured.
        repeats: How often each is measured; the rarer ones are spread over the run.
    """
    for call in calls.values():
        call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    rounds = max(repeats.values())
    for turn in range(rounds):
        for name, call in calls.items():
            if turn * repeats[name] % rounds < repeats[name]:
                start = time.perf_counter()
                call()
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def row(name: str, value: float, unit: str, target: str = "", meets: bool | None = None) -> Row:
    """Return one line of a benchmark's table."""
    return {"name": name, "value": value, "unit": unit, "target": target, "meets": meets}


def print_table(rows: Sequence[Row]) -> None:
    """Print the rows of a benchmark."""
    for entry in rows:
        verdict = {True: "met", False: "MISSED", None: ""}[entry["meets"]]
        print(f"{entry['name']:<58}{entry['value']:>12.4g} {entry['unit']:<6}{entry['target']:<14}{verdict}")
