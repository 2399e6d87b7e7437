"""What the processes of a job tell the one who waits for it: lines, the outcome, and whether to go on."""

from __future__ import annotations

import io
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any

from trainer.cluster.engine import Cluster, connected

POLL_S = 0.25
"""Seconds between two looks at the board."""

PATIENCE_S = 45.0
"""Seconds that a cancelled job gets to end by itself."""

DIED = ("RayActorError", "ActorDiedError", "ActorUnavailableError", "WorkerCrashedError",
        "WorkerHealthCheckFailedError")  # fmt: skip
"""Exceptions of Ray that tell of a process that is no more."""

RAISED = re.compile(r"[\w.]*(Error|Exception|Interrupt|Exit)\b")
"""How the line of a traceback begins that says what was raised."""


class Board:
    """Lines and outcome of one job; lives in the cluster as an actor."""

    def __init__(self) -> None:
        self._lines: list[tuple[str, str]] = []
        self._outcome: tuple[int, str] | None = None
        self._cancelled = False

    def write(self, stream: str, text: str) -> None:
        """Add text for `stdout` or `stderr`."""
        self._lines.append((stream, text))

    def read(self, start: int) -> tuple[list[tuple[str, str]], tuple[int, str] | None]:
        """Return the texts from a number on, and the outcome where there is one."""
        return self._lines[start:], self._outcome

    def end(self, code: int, message: str = "") -> None:
        """Set exit code and message; the first one counts."""
        self._outcome = self._outcome or (code, message)

    def cancel(self) -> None:
        """Ask the job to stop."""
        self._cancelled = True

    def cancelled(self) -> bool:
        """Return whether the job shall stop."""
        return self._cancelled


class _Sender(io.TextIOBase):
    """A text stream whose lines go to a board."""

    def __init__(self, board: Any, stream: str) -> None:
        self._board, self._stream, self._rest = board, stream, ""

    def writable(self) -> bool:
        return True

    def write(self, text: str, /) -> int:
        whole, newline, self._rest = (self._rest + text).rpartition("\n")
        if newline:
            self._board.write.remote(self._stream, whole + newline)
        return len(text)

    def flush(self) -> None:
        """Keep the beginning of a line until its end comes."""

    def finish(self) -> None:
        """Send what has no end of line."""
        if self._rest:
            self._board.write.remote(self._stream, self._rest + "\n")
            self._rest = ""


@contextmanager
def sending(board: Any) -> Iterator[None]:
    """Send what this process prints to a board."""
    streams = _Sender(board, "stdout"), _Sender(board, "stderr")
    with redirect_stdout(streams[0]), redirect_stderr(streams[1]):
        try:
            yield
        finally:
            for stream in streams:
                stream.finish()


def follow(ray: Any, board: Any, job: Any) -> tuple[int, str]:
    """Print what a job writes until it has ended; returns its exit code and message.

    Args:
        ray: The connected module.
        board: The job's board.
        job: Reference to the result of the call that does the job.

    Raises:
        KeyboardInterrupt: Ctrl-C; the job was asked to stop and had time for it.
    """
    seen = 0

    def look() -> tuple[int, str] | None:
        nonlocal seen
        lines, outcome = ray.get(board.read.remote(seen))
        seen += len(lines)
        for stream, text in lines:
            print(text, end="", file=getattr(sys, stream), flush=True)
        return outcome

    def wait(seconds: float) -> tuple[int, str] | None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            done, _ = ray.wait([job], timeout=POLL_S)
            outcome = look()
            if outcome is not None:
                return outcome
            if done:
                ray.get(job)  # raises what made it end
                return look() or (1, "the job ended without an outcome")
        return None

    try:
        while True:
            outcome = wait(3600)
            if outcome is not None:
                return outcome
    except ray.exceptions.RayError as error:
        return 1, f"the process that conducts the job failed: {reason(error)}"
    except KeyboardInterrupt:
        print("cancelling the job (again Ctrl-C: at once)", file=sys.stderr, flush=True)
        with suppress(ray.exceptions.RayError):  # it ended otherwise
            ray.get(board.cancel.remote())
            wait(PATIENCE_S)
        raise


ON_HEAD = {"node:__internal_head__": 0.001}
"""Keeps a process on the cluster's first node, without which there is no cluster; any other may be lost."""


def conduct(cluster: Cluster, conductor: type, *arguments: Any) -> int:
    """Run a job in a cluster and print what it prints; returns its exit code.

    Args:
        cluster: Where.
        conductor: Class whose method `run` does the job, in the cluster; gets the board behind the arguments.
        *arguments: Of the method.

    Raises:
        ValueError: Ray is missing, or the cluster has another release, or too little for the job.
        OSError: The cluster cannot be reached.
        KeyboardInterrupt: Ctrl-C, after the job was cancelled.
    """
    with connected(cluster) as ray:
        board = ray.remote(num_cpus=0, resources=ON_HEAD)(Board).remote()
        head = ray.remote(num_cpus=0, resources=ON_HEAD)(conductor).remote()
        try:
            code, message = follow(ray, board, head.run.remote(*arguments, board))
        finally:
            ray.kill(head)  # whose workers end with it
    if message:
        print(f"error: {message}", file=sys.stderr)
    return code


def reason(error: object) -> str:
    """Return in one line why something failed in the cluster.

    Args:
        error: An exception of Ray, whose text may be a whole traceback, or such a text.
    """
    if type(error).__name__ in DIED:
        return "its process died (killed, out of memory, or its node went away)"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    words = next((line for line in reversed(lines) if RAISED.match(line)), "")
    return (words or (lines[0] if lines else type(error).__name__))[:300]
