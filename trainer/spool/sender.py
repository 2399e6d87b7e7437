"""Sends the journal of a run in the background, beside the training."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import threading
import time
from pathlib import Path

from trainer.progress import duration
from trainer.spool.delivery import Delivery
from trainer.spool.failures import Kind, OutageError, reason
from trainer.spool.journal import SPOOL, Journal, shown
from trainer.spool.sent import Backlog, keep_limit, kept_limit
from trainer.spool.store import described, is_server

INTERVAL_S = 5.0
"""Until the next look where there was nothing to send: rare enough to cost nothing, often enough to watch."""
REST = 50
"""Rest after a group, in times of the processor time that it took: two hundredths of a core go into sending
while training runs, also when hours are made up for. Only a group that takes more than 0.4 s of it, such as
the registration of a model, has a larger share, for that once."""
LONGEST_REST_S = 20.0
LONGEST_WAIT_S = 60.0
PATIENCE_S = 10.0
"""How long the end of a run waits for a store that takes nothing at all."""


class Lock:
    """Lets one process at a time send a journal."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / SPOOL / "lock"
        self._file: int | None = None

    def acquire(self) -> bool:
        """Return whether this process may send; True again while it holds the lock."""
        if self._file is not None:
            return True
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            return False
        except OSError:
            pass  # a file system without locks; what is sent twice does no harm
        self._file = file
        return True

    def release(self) -> None:
        """Let others send."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._file, fcntl.LOCK_UN)  # readers of data were forked with it open
            os.close(self._file)
            self._file = None


class Backoff:
    """Waits that double from a second to a minute, spread at random so that runs do not knock together."""

    def __init__(self) -> None:
        self._next = 1.0

    def __call__(self) -> float:
        """Return the next wait in seconds."""
        wait, self._next = self._next, min(self._next * 2, LONGEST_WAIT_S)
        return wait * random.uniform(0.5, 1.0)

    def reset(self) -> None:
        """Begin again with the shortest."""
        self._next = 1.0


def trouble(outage: OutageError, uri: str) -> str:
    """Return what an outage is, and what mends it, as a sentence."""
    if outage.kind is Kind.DENIED:
        return (
            f"{_upper(described(uri))} refuses the credentials ({outage.reason}); check "
            "MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD, or MLFLOW_TRACKING_TOKEN."
        )
    return f"{_upper(described(uri))} cannot be used ({outage.reason})."


class Sender(threading.Thread):
    """Sends a journal until it is stopped, and tries again after failures.

    It is a thread and not a process: `REST` keeps the time small that it takes, and a process would load
    another PyTorch and MLflow, some hundred megabytes, to save two hundredths of a core.

    Args:
        folder: Folder of the run.
        journal: Its journal.
    """

    def __init__(self, folder: Path, journal: Journal) -> None:
        super().__init__(name="tracking", daemon=True)
        self.folder = folder
        self._journal = journal
        self._delivery = Delivery(folder)
        self._lock = Lock(folder)
        self._wake = threading.Event()
        self._over = threading.Event()
        self._hurry = self._busy = False
        self._backoff = Backoff()
        self._outage: tuple[Kind, float] | None = None
        self._last_success = self._last_failure = time.monotonic()

    def run(self) -> None:
        """Send until `stop`."""
        try:
            while not self._over.is_set():
                self._rest(self._turn())
        finally:
            self._lock.release()

    def deliver_up_to(self, offset: int | None) -> None:
        """Keep from the store what lies behind an offset in bytes of the journal; None: nothing."""
        if offset != kept_limit(self.folder):
            keep_limit(self.folder, offset)
        self._delivery.limit = offset

    def drain(self, wait_s: float) -> int:
        """Wait until everything is sent, at most `wait_s` seconds; returns the number of events left.

        A store that takes nothing at all is waited for `PATIENCE_S` only.
        """
        begin = told = time.monotonic()
        self._last_success, self._hurry = begin, True
        self._backoff.reset()
        self._wake.set()
        backlog = Backlog(self.folder)
        rest = backlog()
        while rest and self.is_alive():
            now = time.monotonic()
            if now - begin > wait_s or (self._useless(begin) and not self._busy):
                break
            if now - told > (3 if is_server(self._delivery.uri) else 15):
                told = now
                doing = "waiting for" if self._outage else "sending to"
                limit = duration(max(wait_s - (now - begin), 0))
                self._delivery.say(f"{doing} {self._delivery.uri}: {rest} events left, at most {limit}")
            self._over.wait(0.05)
            rest = backlog()
        self._hurry = False
        return rest

    def stop(self) -> None:
        """End after the request that is under way; one that hangs is left alone."""
        self._over.set()
        self._wake.set()
        if self.is_alive():
            self.join(timeout=1.0)

    def _useless(self, begin: float) -> bool:
        """Return whether the store has refused everything for long since `begin`."""
        waited = time.monotonic() - max(self._last_success, begin)
        return self._outage is not None and self._last_failure > begin and waited > PATIENCE_S

    def _turn(self) -> float:
        """Send a group; returns the seconds to rest."""
        used = time.thread_time()
        try:
            if not self._lock.acquire():
                return 1.0  # another process sends this journal
            self._busy = True
            moved = self._delivery.step()
        except OutageError as outage:
            self._fail(outage)
            return self._backoff()
        except Exception as error:  # whatever happens to the run's folder, the training goes on
            self._fail(OutageError(Kind.AWAY, reason(error)))
            return self._backoff()
        finally:
            self._busy = False
        if moved:
            self._succeed()
        rest = min(REST * (time.thread_time() - used), LONGEST_REST_S)
        if moved:
            return 0.0 if self._hurry else rest
        return 0.05 if self._hurry else max(INTERVAL_S, rest)

    def _rest(self, seconds: float) -> None:
        """Wait, and see meanwhile that the disk keeps the journal."""
        until = time.monotonic() + seconds
        while not self._over.is_set():
            with contextlib.suppress(OSError):  # the next append says what is wrong with the disk
                self._journal.sync()
            remaining = until - time.monotonic()
            if remaining <= 0 or self._wake.wait(min(remaining, 1.0)):
                break
        self._wake.clear()

    def _fail(self, outage: OutageError) -> None:
        self._last_failure = time.monotonic()
        began = self._outage[1] if self._outage else time.monotonic()
        if self._outage is None or self._outage[0] is not outage.kind:
            self._delivery.say(
                f"{trouble(outage, self._delivery.uri)} Training goes on; what it records is kept in "
                f"{shown(self.folder / SPOOL)} and sent as soon as possible, or by "
                f"`trainer sync {shown(self.folder)}`."
            )
        self._outage = (outage.kind, began)

    def _succeed(self) -> None:
        self._last_success = time.monotonic()
        self._backoff.reset()
        if self._outage is not None:
            away = duration(time.monotonic() - self._outage[1])
            self._outage = None
            self._delivery.say(
                f"{_upper(described(self._delivery.uri))} answers again after {away}; sending goes on."
            )


def wait_for(uri: str) -> float:
    """Return the seconds to wait at the end of a run: a local store takes everything, a server may not."""
    return 120.0 if is_server(uri) else 600.0


def _upper(text: str) -> str:
    return text[0].upper() + text[1:]
