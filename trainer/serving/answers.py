"""Answers: results as they lie on disk, refusals as one sentence, and connections that end well."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.responses import JSONResponse, StreamingResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trainer.serving.limits import Refusal
from trainer.serving.metrics import Metrics
from trainer.serving.room import RETRY
from trainer.serving.work import Done

PATHS = ("/", "/health", "/metrics", "/docs", "/openapi.json", "/denoise")

ALWAYS = ("/health", "/metrics")
"""Paths that are answered however busy the service is."""

_PIECE = 1 << 18
_LINGER = 2.0
_READ = "penumbra.read"
_MAX_HEADER = 2000


class Problem(JSONResponse):
    """An error. What a client still sends is read and dropped for a moment, so that it sees the answer.

    Args:
        refusal: What is answered.
        linger: Seconds of that moment.
    """

    def __init__(self, refusal: Refusal, linger: float = _LINGER) -> None:
        super().__init__({"detail": refusal.detail}, refusal.status, refusal.headers)
        self.linger = linger

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        if scope.get(_READ):
            await super().__call__(scope, receive, send)
            return
        headers = [*self.raw_headers, (b"connection", b"close")]
        await send({"type": "http.response.start", "status": self.status_code, "headers": headers})
        await send({"type": "http.response.body", "body": self.body, "more_body": True})
        with suppress(TimeoutError):
            async with asyncio.timeout(self.linger):
                while not scope.get(_READ) and (await receive())["type"] != "http.disconnect":
                    pass
        await send({"type": "http.response.body", "body": b""})


class Result(StreamingResponse):
    """A denoised file.

    Args:
        done: It.
        seconds: That the client may take to receive it.
        remove: Called when it was sent, or could not be.
    """

    def __init__(self, done: Done, seconds: float, remove: Callable[[], None]) -> None:
        self.seconds, self.remove = seconds, remove
        headers = {
            "Content-Length": str(os.stat(done.path).st_size),
            "Content-Disposition": f'attachment; filename="{done.path.name}"',
            "X-Penumbra-Exposure": repr(done.exposure),
        }
        if done.notes:
            text = "; ".join(done.notes).encode("ascii", "replace").decode()
            headers["X-Penumbra-Notes"] = "".join(c for c in text if c.isprintable())[:_MAX_HEADER]
        super().__init__(_pieces(done.path), headers=headers, media_type=done.kind)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it; a client that does not take it in time is left."""
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(self.seconds):
                    await super().__call__(scope, receive, send)
        finally:
            self.remove()


async def _pieces(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while piece := await asyncio.to_thread(file.read, _PIECE):
            yield piece


class Counting:
    """Counts answers, marks requests whose body was read to its end, and forbids browsers to guess types.

    Where there are too many connections it refuses everything but what tells how the service is.

    Args:
        app: The application.
        metrics: Where answers are counted.
        crowded: Returns whether there are too many connections.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, crowded: Callable[[], bool]) -> None:
        self.app, self.metrics, self.crowded = app, metrics, crowded

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def received() -> Message:
            message = await receive()
            if message["type"] == "http.request" and not message.get("more_body", False):
                scope[_READ] = True
            return message

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                path = scope["path"] if scope["path"] in PATHS else "other"
                self.metrics.requests.labels(path, str(message["status"])).inc()
                extra: list[tuple[bytes, bytes]] = [(b"x-content-type-options", b"nosniff")]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        refused = self.crowded() and scope["path"] not in ALWAYS
        await (Problem(_crowded(), linger=0.0) if refused else self.app)(scope, received, sent)


def _crowded() -> Refusal:
    return Refusal(503, "too many connections are open; try again in 5 s", dict(RETRY))


def described(
    status: int, text: str, headers: dict[str, str] | None = None
) -> dict[int | str, dict[str, Any]]:
    """Return the description of an error in OpenAPI.

    Args:
        status: Of HTTP.
        text: When it comes.
        headers: Name → meaning.
    """
    schema = {"$ref": "#/components/schemas/Problem"}
    entry: dict[str, Any] = {"description": text, "content": {"application/json": {"schema": schema}}}
    if headers:
        entry["headers"] = {n: {"description": t, "schema": {"type": "string"}} for n, t in headers.items()}
    return {status: entry}
