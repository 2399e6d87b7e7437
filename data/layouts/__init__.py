"""Published on-disk layouts, one file each: a root folder becomes scenes, and scenes become frames.

A layout is a module with `describe(root) -> list[Scene]`, `frames(root) -> Iterator[Frame]` and
`likeness(root) -> float`, which says from 0 to 1 how much a folder looks like it. `likeness` looks at names,
and at the headers of a few files where names do not tell; it never raises for a broken file.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

LAYOUTS = (
    "acfm",
    "afgsa",
    "kpcn",
    "nbgd",
    "tungsten",
    "oidn",
    "sbmc",
    "layerdenoise",
    "blender",
    "mitsuba",
    "penumbra",
    "bmfr",
)
"""Names of the layouts; where a folder resembles two equally, the one that asks for more comes first."""


def layout(name: str) -> Any:
    """Return the module of a layout.

    Raises:
        ValueError: There is no such layout; the message lists them.
    """
    if name not in LAYOUTS:
        raise ValueError(f"unknown layout {name!r}; known: {', '.join(sorted(LAYOUTS))}")
    return importlib.import_module(f"data.layouts.{name}")


def likenesses(root: str | Path) -> dict[str, float]:
    """Return how much a folder resembles each layout, those that it resembles at all, best first.

    Folders that cannot be read resemble nothing.
    """
    scores = {name: _likeness(name, Path(root)) for name in LAYOUTS}
    return dict(sorted(((n, s) for n, s in scores.items() if s > 0), key=lambda pair: -pair[1]))


def _likeness(name: str, root: Path) -> float:
    try:
        return float(layout(name).likeness(root))
    except OSError:
        return 0.0


def likeliest(root: str | Path) -> str | None:
    """Return the layout that a folder resembles most, None where it resembles none."""
    return next(iter(likenesses(root)), None)


def closer(root: str | Path, name: str) -> str:
    """Return what to add to an error where a folder resembles another layout than the named one."""
    other = likeliest(root)
    return "" if other in (None, name) else f"; it looks like the layout `{other}`: use --layout {other}"
