"""What `trainer benchmark --output DIR` leaves: all figures as JSON, and plots."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainer.benchmarking.cases import Outcome
from trainer.benchmarking.pairing import Comparison
from trainer.benchmarking.plots import MEMORY_USE, TIME, plot
from trainer.outputs import replacing

NAMES = ("benchmark.json", "time.svg", "memory.svg")


def paths(folder: Path) -> list[Path]:
    """Return the files that may be written."""
    return [folder / name for name in NAMES]


@dataclass(frozen=True)
class Results:
    """The files of one run.

    Attributes:
        folder: Where they are; None: nothing is written.
        machine: From `trainer.benchmarking.machine.describe`.
    """

    folder: Path | None
    machine: dict[str, Any]

    def keep(self, outcomes: Sequence[Outcome], comparisons: Sequence[Comparison]) -> list[Path]:
        """Write all figures so far, in place of those before, and return what was written.

        Raises:
            OSError: Nothing can be written there.
        """
        if self.folder is None:
            return []
        figures, *plots = paths(self.folder)
        content = {
            "penumbra": self.machine["versions"]["penumbra-denoise"],
            "created": self.machine["time"],
            "command": ["trainer", *sys.argv[1:]],
            "machine": self.machine,
            "cases": [outcome.row() for outcome in outcomes],
            "comparisons": [comparison.row() for comparison in comparisons],
        }
        _write(figures, json.dumps(content, indent=1) + "\n")
        for path in plots:  # of a run that this one replaces
            path.unlink(missing_ok=True)
        return [figures]

    def finish(self, outcomes: Sequence[Outcome], comparisons: Sequence[Comparison]) -> list[Path]:
        """Write figures and plots, where there are any, and return what was written; raises as `keep`."""
        if self.folder is None or not outcomes:
            return []
        written = self.keep(outcomes, comparisons)
        if not any(outcome.done for outcome in outcomes):
            return written
        _, time, memory = paths(self.folder)
        _write(time, plot(outcomes, TIME))
        _write(memory, plot(outcomes, MEMORY_USE))
        return [*written, time, memory]


def _write(path: Path, text: str) -> None:
    """Write a text whole, whatever the encoding of the surroundings is."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="replace")
