"""Tells a health check that work goes on: a file is as old as the last batch, sample or frame.

`$PENUMBRA_ALIVE` names it; without the variable nothing is written. `docker/with-progress-of` looks at it.
The file should lie on this machine and belong to one job.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

ALIVE = "PENUMBRA_ALIVE"
INTERVAL_S = 1.0
"""Seconds between two touches, at least."""

_touched = -INTERVAL_S


def touch() -> None:
    """Say that work goes on. A file that cannot be written stops no work: the health check will tell."""
    global _touched
    path, now = os.environ.get(ALIVE), time.monotonic()
    if path and now - _touched >= INTERVAL_S:
        _touched = now
        try:
            Path(path).touch()
        except OSError:
            return
