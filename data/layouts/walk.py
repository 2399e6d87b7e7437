"""Files below a folder: a look at some of them, bounded in time, or all of them."""

from __future__ import annotations

import os
from collections import deque
from itertools import islice
from pathlib import Path

LOOK = 8192
"""Entries that a look passes over: enough to know a layout by, a fraction of a second in any folder."""


def a_few_below(root: Path, ending: str, count: int = 4) -> list[Path]:
    """Return a few of the files with an ending below a folder, spread over those that a look finds."""
    found = files_below(root, (ending,), LOOK) if root.is_dir() else []
    return found[:: max(1, len(found) // count)][:count]


def files_below(root: Path, endings: tuple[str, ...] = ("",), most: int | None = None) -> list[Path]:
    """Return the files below a folder; hidden ones and links to folders are passed over.

    Args:
        root: The folder.
        endings: How names end, lower case; the case of the names does not matter.
        most: Number of entries of any kind to look at, nearest to the root first; folders that cannot be
            read are then passed over. None: all there are, sorted.

    Raises:
        OSError: Without `most`: a folder cannot be read.
    """
    found: list[Path] = []
    folders, seen = deque([os.fspath(root)]), 0
    while folders and (most is None or seen < most):
        folder = folders.popleft()
        try:
            with os.scandir(folder) as entries:
                some = list(islice(entries, None if most is None else most - seen))
        except OSError:
            if most is None:
                raise
            continue
        seen += len(some)
        for entry in sorted(some, key=lambda e: e.name):
            if entry.name.startswith("."):
                continue
            if entry.is_dir(follow_symlinks=False):
                folders.append(entry.path)
            elif entry.name.lower().endswith(endings) and entry.is_file():
                found.append(Path(entry.path))
    return found if most is not None else sorted(found)
