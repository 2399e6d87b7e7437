"""What a request may cost, and how one that costs more is refused."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

CHANNELS = 32
"""Channels that a frame of the largest size may have; frames with more channels may have fewer pixels."""


@dataclass(frozen=True)
class Limits:
    """What requests may cost.

    Attributes:
        megapixels: Largest frame, in millions of pixels, with up to 32 channels.
        upload: Bytes of a request's body.
        disk: Bytes of files of all requests together: uploads, what ZIP files unpack to, results.
        frames: Frames of a ZIP file.
        queue: Requests that wait for those that run; as many again may be sending their body.
        read: Seconds that a body may take to come in.
        idle: Seconds without a byte of it.
        compute: Seconds from the last byte of a request to its result, waiting included.
        send: Seconds that a client may take to receive its result.
        decode: Seconds that one frame may take to be decoded.
    """

    megapixels: float = 10.0
    upload: int = 256 * 10**6
    disk: int = 2 * 10**9
    frames: int = 64
    queue: int = 16
    read: float = 60.0
    idle: float = 10.0
    compute: float = 120.0
    send: float = 120.0
    decode: float = 30.0

    @property
    def pixels(self) -> int:
        """Pixels of the largest frame."""
        return int(self.megapixels * 1e6)

    @property
    def frame_bytes(self) -> int:
        """Bytes of the largest frame in float32; no more is decoded at a time for all requests together."""
        return 4 * CHANNELS * self.pixels

    @property
    def unpacked(self) -> int:
        """Bytes that a ZIP file may unpack to: EXR files are compressed already."""
        return 2 * self.upload


class Refusal(Exception):  # noqa: N818  # an answer, not an error of ours
    """A request is answered with an error.

    Args:
        status: Of HTTP.
        detail: What is wrong, what was expected and what to do; never a path of this machine.
        headers: More headers of the answer.
    """

    def __init__(self, status: int, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, headers or {}


class Over(Exception):  # noqa: N818  # no error: work that stops
    """Nobody waits for the result any more: the client went away, or its time is up."""


@dataclass
class Ticket:
    """The right of a request to be worked on, until its time is up or its client goes away.

    Attributes:
        deadline: `time.monotonic` at which its time is up.
    """

    deadline: float
    _gone: threading.Event = field(default_factory=threading.Event)

    def cancel(self) -> None:
        """Stop the work at the next tile."""
        self._gone.set()

    @property
    def over(self) -> bool:
        """Whether the work is to stop; `Over` is raised for it."""
        return self._gone.is_set() or time.monotonic() > self.deadline

    def check(self) -> None:
        """Raise `Over` where the work is to stop."""
        if self.over:
            raise Over


class Budget:
    """Bytes that requests share: who wants more than is left waits.

    Args:
        total: Bytes; nobody may want more.
    """

    def __init__(self, total: int) -> None:
        self.total, self.held = total, 0
        self._changed = threading.Condition()

    @contextmanager
    def hold(self, size: int, ticket: Ticket) -> Iterator[None]:
        """Hold bytes while the block runs.

        Raises:
            Over: Nobody waits for the result any more.
        """
        with self._changed:
            while self.held + size > self.total:
                ticket.check()
                self._changed.wait(0.1)
            self.held += size
        try:
            yield
        finally:
            with self._changed:
                self.held -= size
                self._changed.notify_all()
