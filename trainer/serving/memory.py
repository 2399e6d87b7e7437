"""What a service may take of memory and disk by its limits, compared with what there is."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from data.exr_image import COPIES
from trainer.serving.batching import Batching
from trainer.serving.limits import CHANNELS, Limits
from trainer.serving.reader import SCRATCH
from trainer.serving.readers import READERS

PROCESS = 800 << 20
"""Bytes of the process before a request: PyTorch, MLflow and a network of some megabytes."""

READER = 64 << 20
"""Bytes of the libraries of a process that decodes."""


def needed(limits: Limits, batch: int) -> int:
    """Return the bytes of memory that a service may take, files in a temporary folder left out.

    All frames that are held at a time have `limits.frame_bytes` together, and while they are decoded as much
    as a reader may take for them beside what has arrived.

    Args:
        limits: Of requests.
        batch: Bytes that the model may take.
    """
    return PROCESS + READERS * (READER + SCRATCH) + (COPIES + 1) * limits.frame_bytes + batch


def available(root: Path = Path("/")) -> tuple[int, str]:
    """Return the bytes of memory that this process may use, and what sets them.

    Args:
        root: Where `proc` and `sys` are.
    """
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    groups = [(int(text), "its control group") for text in _group_limits(root) if text.isdigit()]
    return min([(machine, "this machine"), *groups])


def _group_limits(root: Path) -> Iterator[str]:
    """Yield the limits of the process's control group and those above it, of both versions of Linux's."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        mount, name = ("memory", "memory.limit_in_bytes") if controllers else ("", "memory.max")
        top = root / "sys/fs/cgroup" / mount
        place = top / group.lstrip("/")
        # In a container the group may be one of the host, while its limit is at the top of what is mounted.
        for folder in (place, *place.parents):
            if (folder / name).is_file():
                yield (folder / name).read_text().strip()
            if folder == top:
                break


def in_memory(folder: Path, root: Path = Path("/")) -> bool:
    """Return whether files in a folder take memory."""
    try:
        lines = (root / "proc/self/mounts").read_text().splitlines()
    except OSError:
        return False
    mounts = {Path(line.split()[1].encode().decode("unicode_escape")): line.split()[2] for line in lines}
    resolved = folder.resolve()
    return next((mounts[path] for path in (resolved, *resolved.parents) if path in mounts), "") == "tmpfs"


def shortages(limits: Limits, batching: Batching, folder: Path, root: Path = Path("/")) -> list[str]:
    """Return a sentence for each of memory and disk that requests may exhaust.

    Args:
        limits: Of requests.
        batching: Whose memory is that of this machine.
        folder: The temporary folder.
        root: Where `proc` and `sys` are.
    """
    found = []
    files = limits.disk if in_memory(folder, root) else 0
    most, (there, whose) = needed(limits, batching.memory) + files, available(root)
    if most > there:
        more = f", {files / 1e9:.1f} GB of files in {folder} (--disk)" if files else ""
        found.append(
            f"requests may take up to {most / 1e9:.1f} GB of memory, but {whose} has {there / 1e9:.1f} GB: "
            f"{(COPIES + 1) * limits.frame_bytes / 1e9:.1f} GB while {limits.megapixels:g} megapixels with "
            f"{CHANNELS} channels are decoded (--max-megapixels), {batching.memory / 1e9:.1f} GB for the "
            f"model (--memory){more}; lower them"
        )
    free = shutil.disk_usage(folder).free
    if limits.disk > free:
        found.append(
            f"files of requests may take up to {limits.disk / 1e9:.1f} GB, but {folder} has "
            f"{free / 1e9:.1f} GB left; lower --disk, or set TMPDIR to another folder"
        )
    return found
