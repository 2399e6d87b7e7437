"""Servers as ordinary processes: stopped by their own process number, their output kept in a file."""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path


def free_ports(count: int) -> list[int]:
    """Return different ports of the loopback interface that nobody listens on."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()


class ServerError(RuntimeError):
    """A server does not run; the message has the end of its output."""


class Server:
    """One server and its children.

    Args:
        command: Program and arguments.
        environment: The whole environment.
        folder: Working directory.
        log: File that gets standard output and errors; later starts add to it.
        health: Command that succeeds once the server answers.
        user: Name of the user to run as; the current one where None.
    """

    def __init__(
        self, command: list[str], environment: dict[str, str], folder: Path, log: Path,
        *, health: list[str], user: str | None = None,
    ) -> None:  # fmt: skip
        self.command = command
        self.environment = environment
        self.folder = folder
        self.log = log
        self.health = health
        self.user = user
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Number of the process, which is also that of its group."""
        assert self.process is not None, "the server was not started"
        return self.process.pid

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self.process is not None and self.process.poll() is None

    def start(self, timeout_s: float = 180.0) -> None:
        """Start the server and wait until its health check succeeds.

        Raises:
            ServerError: It ended, or did not answer in time.
        """
        self.launch()
        self.wait(timeout_s)

    def launch(self) -> None:
        """Start the server without waiting for it."""
        assert not self.running, "the server runs already"
        # If the process that started it is killed, it ends too. PostgreSQL waits for its clients on SIGTERM.
        number = "INT" if Path(self.command[0]).name == "postgres" else "TERM"
        bound = ["setpriv", "--pdeathsig", number] if shutil.which("setpriv") else []
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(
                [*bound, *self.command], cwd=self.folder, env=self.environment, start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=output, stderr=output, user=self.user,
                group=self.user and _group(self.user), extra_groups=[] if self.user else None,
            )  # fmt: skip

    def wait(self, timeout_s: float = 180.0) -> None:
        """Wait until the health check succeeds.

        Raises:
            ServerError: The server ended, or did not answer in time.
        """
        deadline = time.monotonic() + timeout_s
        while not self.healthy():
            if not self.running:
                raise ServerError(f"{self.command[0]} ended\n{self.output()}")
            if time.monotonic() > deadline:
                raise ServerError(
                    f"{self.command[0]} does not answer after {timeout_s:.0f} s\n{self.output()}"
                )
            time.sleep(0.3)

    def healthy(self) -> bool:
        """Run the health check once."""
        done = subprocess.run(self.health, cwd=self.folder, env=self.environment, capture_output=True)
        return done.returncode == 0

    def stop(self, number: signal.Signals = signal.SIGTERM, timeout_s: float = 30.0) -> None:
        """Send a signal to the server and its children and wait for its end; SIGKILL after a time-out."""
        if self.process is None:
            return
        try:
            os.killpg(self.pid, number)
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pass
        except ProcessLookupError:
            self.process.wait(timeout_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)  # children that outlived it
        self.process.wait(timeout_s)

    def kill(self) -> None:
        """End the server and its children at once, as a crash does."""
        self.stop(signal.SIGKILL)

    def freeze(self) -> None:
        """Stop the server from answering; connections stay open, as on a hung machine."""
        os.killpg(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let a frozen server go on."""
        os.killpg(self.pid, signal.SIGCONT)

    def output(self, lines: int = 60) -> str:
        """Return the last lines of the log."""
        if not self.log.exists():
            return ""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])


def _group(user: str) -> int:
    return pwd.getpwnam(user).pw_gid
