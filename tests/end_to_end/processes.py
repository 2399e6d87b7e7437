"""Finds the processes of a training that torchrun started, so that tests can end one of them."""

from __future__ import annotations

import contextlib
import os
import signal

import psutil


def ranks(agent: int) -> list[psutil.Process]:
    """Return the processes of the ranks below a torchrun agent, in the order of their rank."""
    return sorted(psutil.Process(agent).children(), key=_rank)


def readers(agent: int) -> list[psutil.Process]:
    """Return the processes that read data for the ranks."""
    found = []
    for rank in ranks(agent):
        with contextlib.suppress(psutil.Error):
            found += [child for child in rank.children() if child.cmdline() == rank.cmdline()]
    return found


def kill(process: psutil.Process) -> bool:
    """End a process without warning; returns whether it was there."""
    try:
        os.kill(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _rank(process: psutil.Process) -> int:
    try:
        return int(process.environ().get("RANK", "-1"))
    except psutil.Error:
        return -1
