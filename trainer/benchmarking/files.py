"""What `trainer benchmark --output DIR` leaves: all figures as JSON, and plots."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trainer.benchmarking.cases import Outcome
from trainer.benchmarking.pairing import Comparison
from trainer.benchmarking.plots import MEMORY_USE, TIME, plot
from trainer.outputs import write_whole

NAMES = ("benchmark.json", "time.svg", "memory.svg")


def paths(folder: Path) -> list[Path]:
    """Return the files that may be written."""
    return [folder / name for name in NAMES]


def write(
    folder: Path, machine: dict[str, Any], outcomes: Sequence[Outcome], comparisons: Sequence[Comparison]
) -> list[Path]:
    """Write everything and return what was written.

    Raises:
        OSError: Nothing can be written there.
    """
    figures, time, memory = paths(folder)
    content = {
        "penumbra": machine["versions"]["penumbra-denoise"],
        "created": machine["time"],
        "command": ["trainer", *sys.argv[1:]],
        "machine": machine,
        "cases": [outcome.row() for outcome in outcomes],
        "comparisons": [comparison.row() for comparison in comparisons],
    }
    write_whole(figures, json.dumps(content, indent=1) + "\n")
    if not any(outcome.done for outcome in outcomes):
        return [figures]
    write_whole(time, plot(outcomes, TIME))
    write_whole(memory, plot(outcomes, MEMORY_USE))
    return [figures, time, memory]
