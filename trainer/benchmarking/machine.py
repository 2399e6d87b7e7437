"""The machine that figures were measured on."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

VERSIONS = ("penumbra-denoise", "torch", "onnxruntime", "numba", "numpy")


def describe() -> dict[str, Any]:
    """Return processor, memory, system and versions."""
    import psutil

    return {
        "processor": processor(),
        "cores": psutil.cpu_count(logical=False) or os.cpu_count(),
        "threads": usable_threads(),
        "memory_bytes": psutil.virtual_memory().total,
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in VERSIONS},
        "environment": {n: v for n, v in sorted(os.environ.items()) if n.endswith("_NUM_THREADS")},
        "load": os.getloadavg()[0],
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def usable_threads() -> int:
    """Return how many threads of the processor this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the name of the processor's model."""
    try:
        lines = cpuinfo.read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() == "model name" and value.strip():
            return " ".join(value.split())
    return platform.processor() or platform.machine()


def in_words(machine: dict[str, Any]) -> str:
    """Return the description in one or two lines."""
    versions = ", ".join(
        f"{name} {number}"
        for name, number in machine["versions"].items()
        if name in ("torch", "onnxruntime", "numba") and number
    )
    threads = machine["threads"]
    return (
        f"{machine['processor']}, {threads} thread{'s' * (threads != 1)}, "
        f"{machine['memory_bytes'] / 1e9:.0f} GB; {versions}; Python {machine['python']}"
    )
