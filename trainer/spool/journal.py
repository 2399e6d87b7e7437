"""The journal of a run: everything that it records, in order, in `spool/journal.jsonl` of its folder.

    spool/journal.jsonl      one event a line
    spool/files/             files as they were when they were recorded
    spool/sent.json          how far the tracking store has it
    spool/rejected.jsonl     what the store refused, with the reason

An event is appended in one write, so that a killed process loses nothing that it recorded before and leaves
at most one torn line, which readers skip.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SPOOL = "spool"
JOURNAL = "journal.jsonl"
CHUNK = 1 << 20
PENDING_LIMIT = 200_000
"""Events that are kept in memory while the disk is full."""
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)

Event = dict[str, Any]


class Clock:
    """Milliseconds since 1970 that never go back: the wall clock is read once.

    Args:
        after: The last time that the run recorded, 0 for none; an earlier wall clock was set back meanwhile.
    """

    def __init__(self, after: int = 0) -> None:
        self._base = max(int(time.time() * 1000), after + 1)
        self._start = time.clock_gettime(_CLOCK)

    def __call__(self) -> int:
        """Return the time."""
        return self._base + int((time.clock_gettime(_CLOCK) - self._start) * 1000)


class Journal:
    """Appends events to the journal of a run.

    While the disk is full events stay in memory and are written as soon as there is space. A process that
    ends before then loses none for good: checkpoints cannot be written either, so that the continued run
    takes the same steps again.

    Args:
        folder: Folder of the run.
        after: The last time in the journal, in milliseconds.
        name: File to write, where it is not the journal itself.
    """

    def __init__(self, folder: Path, after: int = 0, name: str = JOURNAL) -> None:
        self.folder = folder / SPOOL
        self.folder.mkdir(parents=True, exist_ok=True)
        self.path = self.folder / name
        self._file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        size = os.fstat(self._file).st_size
        self._torn = size > 0 and os.pread(self._file, 1, size - 1) != b"\n"
        self._lock = threading.Lock()
        self._pending: list[bytes] = []
        self._full = False
        self._unsynced = False
        self.now = Clock(after)

    def append(self, event: Event) -> None:
        """Write an event down, with the time.

        Raises:
            OSError: The disk has been full for very long, or the file cannot be written.
        """
        with self._lock:
            stamped = {"t": self.now(), **event}
            self._pending.append(json.dumps(stamped, ensure_ascii=False).encode() + b"\n")
            self._write()

    def flush(self) -> bool:
        """Write what waits for space; returns whether all is written."""
        with self._lock:
            self._write()
            return not self._pending

    def sync(self) -> None:
        """Have the disk keep what was written, through a power cut too."""
        if self._unsynced:
            self._unsynced = False
            os.fsync(self._file)

    def close(self) -> int:
        """Write and keep everything; returns the number of events that no disk space was left for."""
        with self._lock:
            self._write()
            left = len(self._pending)
            if self._file >= 0:
                self.sync()
                os.close(self._file)
                self._file = -1
            return left

    def keep(self, path: Path) -> dict[str, str]:
        """Keep a file as it is now; returns its place below the spool and its SHA-256.

        A link is enough: our files are replaced, never changed.
        """
        with open(path, "rb") as source:
            digest = hashlib.file_digest(source, "sha256").hexdigest()
        kept = self._place(digest, path.name)
        if not kept.exists():
            try:
                os.link(path, kept)
            except OSError:
                _whole(kept, lambda partial: shutil.copyfile(path, partial))
        return {"file": str(kept.relative_to(self.folder)), "sha256": digest}

    def keep_bytes(self, data: bytes, name: str) -> dict[str, str]:
        """Keep bytes as a file; returns its place below the spool and its SHA-256."""
        digest = hashlib.sha256(data).hexdigest()
        kept = self._place(digest, name)
        if not kept.exists():
            _whole(kept, lambda partial: partial.write_bytes(data))
        return {"file": str(kept.relative_to(self.folder)), "sha256": digest}

    def _place(self, digest: str, name: str) -> Path:
        folder = self.folder / "files" / digest[:16]
        folder.mkdir(parents=True, exist_ok=True)
        return folder / name

    def _write(self) -> None:
        if not self._pending or self._file < 0:
            return
        text = b"\n" * self._torn + b"".join(self._pending)
        try:
            written = os.write(self._file, text)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT) or len(self._pending) > PENDING_LIMIT:
                raise OSError(f"cannot write {self.path}: {error.strerror}") from error
            written = 0
        self._unsynced = self._unsynced or written > 0
        if written == len(text):
            self._torn = False
            self._pending.clear()
            if self._full:
                self._full = False
                print(f"There is space again: what was recorded is in {shown(self.path)}.", file=sys.stderr)
            return
        self._drop(written)
        if not self._full:
            self._full = True
            print(
                f"The disk is full: {shown(self.path)} cannot be written. What is recorded stays in memory "
                "until there is space; free some before the next checkpoint is due.",
                file=sys.stderr,
            )

    def _drop(self, written: int) -> None:
        """Forget the lines that a short write has written whole."""
        if written == 0:
            return
        rest = written - self._torn
        while rest >= len(self._pending[0]):
            rest -= len(self._pending.pop(0))
        self._torn = rest > 0


def shown(path: Path) -> str:
    """Return a path for messages: below the current directory where it lies there."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def _whole(target: Path, write: Any) -> None:
    """Write a file whole or not at all."""
    partial = target.with_name(f".{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        write(partial)
        os.replace(partial, target)
    except OSError as error:
        raise OSError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def events(folder: Path, offset: int = 0) -> Iterator[tuple[Event, int]]:
    """Yield the events of a run's journal and the offset behind each, from `offset` in bytes.

    Lines that are torn are skipped; one that is not ended yet is left.
    """
    path = folder / SPOOL / JOURNAL
    if not path.exists():
        return
    with open(path, "rb") as file:
        file.seek(offset)
        for line in file:
            if not line.endswith(b"\n"):
                return
            offset += len(line)
            event = parsed(line)
            if event is not None:
                yield event, offset


def journal_size(folder: Path) -> int:
    """Return the bytes of a run's journal, 0 where it has none."""
    path = folder / SPOOL / JOURNAL
    return path.stat().st_size if path.exists() else 0


def parsed(line: bytes) -> Event | None:
    """Return the event of a line, None where the line is torn."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and "type" in event and "t" in event else None


def number(value: float) -> float | str:
    """Return a number as JSON can hold it: NaN and infinities as words."""
    return value if math.isfinite(value) else str(value)
