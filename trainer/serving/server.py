"""uvicorn with limits that it lacks: time for a request's headers, and for a connection to close."""

from __future__ import annotations

import asyncio
import signal
import sys
from types import FrameType
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from trainer.serving.app import create_app
from trainer.serving.service import Service

HEADER_SECONDS = 10.0
"""Seconds that the headers of a request may take, from the first byte of a connection on."""

CLOSE_SECONDS = 10.0
"""Seconds after which a connection that is to be closed is cut off, though its client takes nothing."""

_LOOK = 1.0
_MORE_CONNECTIONS = 64
_SPARE = 64
"""Connections beyond those at which requests are refused; on them a probe is answered."""


class Protocol(H11Protocol):
    """A connection that a client cannot hold by sending or taking nothing."""

    _watch: asyncio.TimerHandle | None = None
    _waiting = _closing = 0.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # uvicorn would refuse probes as well; the application refuses all others.
        self._most, self.limit_concurrency = self.config.limit_concurrency or sys.maxsize, None
        self._made = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start to look after the connection."""
        super().connection_made(transport)
        self._look()
        if len(self.connections) > self._most + _SPARE:
            self._make_way()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop to look after it."""
        if self._watch is not None:
            self._watch.cancel()
        super().connection_lost(exc)

    def _look(self) -> None:
        """Count the seconds without a request, and those that it takes to close."""
        self._waiting = self._waiting + _LOOK if self._idle else 0.0
        self._closing = self._closing + _LOOK if self.transport.is_closing() else 0.0
        if self._closing > CLOSE_SECONDS or self._waiting > HEADER_SECONDS:
            self.transport.abort()
            return
        self._watch = self.loop.call_later(_LOOK, self._look)

    @property
    def _idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _make_way(self) -> None:
        """Cut off the connection that has been without a request for longest, so that a new one is heard."""
        idle = [
            c
            for c in self.connections
            if isinstance(c, Protocol) and c._idle and not c.transport.is_closing()
        ]
        max(idle, key=lambda c: (c._waiting, -c._made)).transport.abort()


class Server(uvicorn.Server):
    """Refuses new requests when it is told to end, and finishes those that it has.

    Args:
        config: Of uvicorn.
        service: What it serves.
    """

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self.service = service

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to end."""
        self.service.draining = True
        super().handle_exit(sig, frame)
        if sig == signal.SIGTERM:
            self._captured_signals.remove(sig)  # it was obeyed: the exit code is 0


def make_server(service: Service, **options: Any) -> Server:
    """Return a server; its `run(sockets=[…])` serves until SIGTERM or SIGINT.

    Args:
        service: What is served.
        options: More of uvicorn.
    """
    limits = service.limits
    most = 4 * (limits.queue + service.active) + _MORE_CONNECTIONS
    config = uvicorn.Config(
        create_app(service),
        http=Protocol,
        ws="none",
        lifespan="on",
        server_header=False,
        timeout_graceful_shutdown=int(limits.compute + limits.send),
        timeout_keep_alive=int(HEADER_SECONDS),
        limit_concurrency=most,
        **options,
    )
    server = Server(config, service)
    service.crowded = lambda: len(server.server_state.connections) > most
    return server
