"""What a run has recorded already."""

from __future__ import annotations

import math
from pathlib import Path

from trainer.spool.journal import Event, events


class Recorded:
    """What a journal holds already, so that nothing is recorded twice.

    Training is repeated to the bit when it continues from a checkpoint: of a step that was recorded before,
    the first numbers stay.
    """

    def __init__(self) -> None:
        self.id = ""
        self.last_ms = 0
        self.trained = False
        self.params: dict[str, str] = {}
        self._steps: dict[str, dict[int, float]] = {}
        self._seen: set[tuple[str, ...]] = set()
        self._files: dict[str, str] = {}

    @classmethod
    def of(cls, folder: Path) -> Recorded:
        """Return what the journal of a run holds."""
        recorded = cls()
        for event, _ in events(folder):
            recorded.add(event)
        return recorded

    def add(self, event: Event) -> None:
        """Take an event into account."""
        self.last_ms = max(self.last_ms, int(event["t"]))
        kind = event["type"]
        if kind == "run":
            self.id = self.id or event["id"]
        elif kind == "metrics":
            for key, value in event["values"].items():
                self._steps.setdefault(key, {})[event["step"]] = float(value)
        elif kind == "params":
            self.params |= {key: value for key, value in event["values"].items() if key not in self.params}
        elif kind == "file":
            self._files[event["to"]] = event["sha256"]
        elif kind in ("picture", "model"):
            self._seen.add(_identity(event))
        elif kind == "status" and not event.get("evaluation"):
            self.trained = True

    def has_value(self, key: str, step: int) -> bool:
        """Return whether a metric was recorded at a step."""
        return step in self._steps.get(key, {})

    def has_equal(self, key: str, step: int, value: float) -> bool:
        """Return whether this very value of a metric was recorded last at a step."""
        known = self._steps.get(key, {}).get(step)
        return known is not None and (known == value or (math.isnan(known) and math.isnan(value)))

    def next_step(self, prefix: str) -> int:
        """Return the step after the last one of the metrics whose names begin so."""
        steps = [max(found) for key, found in self._steps.items() if key.startswith(prefix) and found]
        return max(steps, default=-1) + 1

    def has(self, event: Event) -> bool:
        """Return whether a file, a picture or a model is recorded."""
        if event["type"] == "file":
            return self._files.get(event["to"]) == event["sha256"]
        return _identity(event) in self._seen


def _identity(event: Event) -> tuple[str, ...]:
    if event["type"] == "picture":
        return ("picture", event["key"], str(event["step"]))
    return ("model", event["name"], event["weights"])
