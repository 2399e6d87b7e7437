"""The pool of processes that decode uploaded files."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import select
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data.frame import Frame
from trainer.serving.limits import Limits, Over, Refusal, Ticket
from trainer.serving.reader import READY, argument, command
from trainer.serving.room import RETRY, no_room
from trainer.serving.wire import MAX_LINE, Parcel, receive, unpack

READERS = 2
"""Processes of a service."""

START_S = 60.0
"""Seconds in which a process has to come up."""

_PATIENCE = 0.05
_PASSED_ON = ("PATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TZ")


class Readers:
    """Decodes uploaded files in processes of their own.

    Args:
        count: Processes.
        limits: Of a request; a process has the memory that the largest frame needs, and no more.

    Attributes:
        deaths: Processes that died or hung; not those that were ended since nobody waited any more.
    """

    def __init__(self, count: int, limits: Limits) -> None:
        self.limits, self.deaths = limits, 0
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        self._all: set[_Process] = set()
        for _ in range(count):
            self._idle.put(self._start())

    def room(self, folder: Path, name: str, ticket: Ticket) -> int:
        """Return the bytes that `frames` will write, at most; raises as it does."""
        parcel = self._ask({"what": "room", "folder": str(folder), "name": name}, ticket)
        return int(parcel.values["bytes"])

    def frames(self, folder: Path, name: str, ticket: Ticket) -> list[dict[str, Any]]:
        """Return `name` and `bytes` of each frame of an uploaded file, which is unpacked where it is a ZIP.

        Raises:
            Refusal: The file is damaged or hostile, or the disk is full.
            Over: Nobody waits for the result any more.
        """
        parcel = self._ask({"what": "list", "folder": str(folder), "name": name}, ticket)
        return list(parcel.values["frames"])

    def read(
        self, folder: Path, name: str, layers: Mapping[str, str], ticket: Ticket
    ) -> tuple[Frame, list[str]]:
        """Return a frame and the remarks of its reader; raises as `frames`."""
        what = {"what": "read", "folder": str(folder), "name": name, "layers": dict(layers)}
        return unpack(self._ask(what, ticket))

    def close(self) -> None:
        """End all processes."""
        for process in list(self._all):
            process.end()
        self._all.clear()

    def _start(self) -> _Process:
        process = _Process(self.limits)
        self._all.add(process)
        return process

    def _ask(self, request: Mapping[str, Any], ticket: Ticket) -> Parcel:
        with self._process(ticket) as process:
            parcel = process.ask(request, ticket)
        if parcel.values.get("full"):
            raise no_room()
        if "error" in parcel.values:
            raise Refusal(422, parcel.values["error"])
        return parcel

    def _free(self, ticket: Ticket) -> _Process:
        while True:
            ticket.check()
            try:
                return self._idle.get(timeout=_PATIENCE)
            except queue.Empty:
                continue

    @contextmanager
    def _process(self, ticket: Ticket) -> Iterator[_Process]:
        """Lend a process; one that was given up is replaced."""
        process = self._free(ticket)
        try:
            yield process
        except BaseException as error:
            # It died, hangs, or is in the middle of something that nobody wants any more.
            self.deaths += not isinstance(error, Over)
            process.end()
            self._all.discard(process)
            process = self._start()
            raise
        finally:
            self._idle.put(process)


class _Process:
    """One process and the pipes to it."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False
        self._held = b""
        with contextlib.suppress(OSError):  # the machine has no room for it now; the next request tries again
            self._start()

    def _start(self) -> None:
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
        # Secrets of the server are none of its business; threads of libraries would take address space.
        environment |= {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
                        "MALLOC_ARENA_MAX": "2"}  # fmt: skip
        self._process = subprocess.Popen(
            [*command(), argument(self.limits)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, env=environment, start_new_session=True, bufsize=0,
        )  # fmt: skip
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._out = self._process.stdin, self._process.stdout.fileno()
        os.set_blocking(self._out, False)

    def ask(self, request: Mapping[str, Any], ticket: Ticket) -> Parcel:
        """Return the answer to a request.

        Raises:
            Refusal: The process died or took too long; 503 where it did not even come up.
            Over: Nobody waits for the result any more.
        """
        self._begin(ticket)
        until = time.monotonic() + self.limits.decode
        try:
            self._stdin.write(json.dumps(request).encode() + b"\n")
            return receive(
                lambda: self._line(until, ticket),
                lambda view: self._fill(view, until, ticket),
                2 * self.limits.frame_bytes,
            )
        except (BrokenPipeError, EOFError, ValueError, KeyError, TypeError):
            raise Refusal(
                422, "the file made the reader of EXR files fail: it is damaged, or made to; render it again"
            ) from None

    def end(self) -> None:
        """End the process."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        self._stdin.close()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _begin(self, ticket: Ticket) -> None:
        """Wait until the process is up, which says nothing about the file."""
        if self._ready:
            return
        try:
            if self._process is None:
                self._start()
            self._ready = self._line(time.monotonic() + START_S, ticket) + b"\n" == READY
        except (OSError, EOFError, Refusal):
            pass
        if not self._ready:
            raise Refusal(503, "the server's reader of files does not start; try again in 5 s", dict(RETRY))

    def _wait(self, until: float, ticket: Ticket) -> None:
        """Wait until there is something to read."""
        while not select.select([self._out], [], [], _PATIENCE)[0]:
            if ticket.over:
                raise Over
            if time.monotonic() > until:
                raise Refusal(
                    422, f"the file could not be decoded within {self.limits.decode:g} seconds; it is damaged"
                )

    def _line(self, until: float, ticket: Ticket) -> bytes:
        while b"\n" not in self._held:
            self._wait(until, ticket)
            piece = os.read(self._out, 1 << 16)
            if not piece or len(self._held) > MAX_LINE:
                raise EOFError
            self._held += piece
        line, _, self._held = self._held.partition(b"\n")
        return line

    def _fill(self, view: memoryview, until: float, ticket: Ticket) -> None:
        start = min(len(view), len(self._held))
        view[:start] = self._held[:start]
        self._held = self._held[start:]
        while start < len(view):
            self._wait(until, ticket)
            got = os.readv(self._out, [view[start:]])
            if not got:
                raise EOFError
            start += got
