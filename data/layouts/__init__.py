"""Published on-disk layouts, one file each: a root folder becomes scenes, and scenes become frames.

A layout is a module with `describe(root) -> list[Scene]`, `frames(root) -> Iterator[Frame]` and
`likeness(root) -> float`, which says from 0 to 1 how much a folder looks like it.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

LAYOUTS = ("bmfr", "penumbra")


def layout(name: str) -> Any:
    """Return the module of a layout.

    Raises:
        ValueError: There is no such layout; the message lists them.
    """
    if name not in LAYOUTS:
        raise ValueError(f"unknown layout {name!r}; known: {', '.join(LAYOUTS)}")
    return importlib.import_module(f"data.layouts.{name}")


def likeliest(root: str | Path) -> str | None:
    """Return the layout that a folder resembles most, None where it resembles none."""
    scores = {name: layout(name).likeness(Path(root)) for name in LAYOUTS}
    best = max(scores, key=lambda name: scores[name])
    return best if scores[best] > 0 else None
