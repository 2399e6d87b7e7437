"""Folders and files that keep their names."""

from __future__ import annotations

import os
from pathlib import Path

UPLOAD = "upload.json"
"""At a URL: whose shards are being sent there; gone when all are."""


def cache_folder() -> Path:
    """Return where automatically prepared shards are kept: `$PENUMBRA_CACHE`, or ~/.cache/penumbra."""
    return Path(os.environ.get("PENUMBRA_CACHE") or Path.home() / ".cache" / "penumbra").absolute()


def remote_folder() -> Path:
    """Return where copies of shards at URLs are kept."""
    return cache_folder() / "remote"
