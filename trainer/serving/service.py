"""The life of a request: admitted, received, waiting, worked on, answered; bounded at every step."""

from __future__ import annotations

import asyncio
import ctypes
import hmac
import itertools
import logging
import math
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from trainer.denoising import Settings
from trainer.loading import Loaded
from trainer.serving.answers import Problem, Result
from trainer.serving.batching import Batcher, Batching, Failed
from trainer.serving.limits import Limits, Over, Refusal, Ticket
from trainer.serving.metrics import Metrics
from trainer.serving.readers import READERS, Readers
from trainer.serving.room import RETRY, Place, Room, is_full, no_room
from trainer.serving.upload import check_headers, receive
from trainer.serving.work import Done, Wish, Workshop

_LOG = logging.getLogger("penumbra.serve")
_GONE = 499
_TRIM_SECONDS = 1.0


class Service:
    """Denoises what requests bring.

    Args:
        loaded: The model.
        settings: How to denoise.
        limits: Of requests.
        batching: How tiles of several requests are joined.
        token: What clients must show; None: nothing.
    """

    def __init__(
        self, loaded: Loaded, settings: Settings, limits: Limits, batching: Batching, token: str | None = None
    ) -> None:
        self.loaded, self.limits, self.token = loaded, limits, token
        loaded.deployed  # noqa: B018  # before several threads ask for it
        # One more than a batch takes: it is decoded while the others are denoised.
        self.active = batching.most + 1
        self.sending = self.admitted = 0
        self.draining = False
        self.crowded: Callable[[], bool] = lambda: False
        self.seconds = 1.0
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._trimmed = 0.0
        self.readers = Readers(READERS, limits)
        self.metrics = Metrics(
            loaded, lambda: max(0, self.admitted - self.active), lambda: self.readers.deaths
        )
        self.batcher = Batcher(batching, self.metrics.told)
        self.workshop = Workshop(loaded, settings, limits, self.batcher, self.readers)
        self._threads = ThreadPoolExecutor(self.active, "request")
        self._temporary = tempfile.TemporaryDirectory(prefix="penumbra-serve-")
        self._numbers = itertools.count()
        self.room = Room(limits.disk)

    def close(self) -> None:
        """End threads and processes and remove files; requests must be finished before."""
        self._threads.shutdown(cancel_futures=True)
        self.batcher.close()
        self.readers.close()
        self._temporary.cleanup()

    def authorize(self, request: Request) -> None:
        """Check the token.

        Raises:
            Refusal: It is missing or wrong.
        """
        if self.token is None:
            return
        given = request.headers.get("authorization", "")
        kind, _, token = given.partition(" ")
        same = hmac.compare_digest(token.strip().encode("latin-1", "replace"), self.token.encode())
        if kind.lower() != "bearer" or not same:
            raise Refusal(
                401,
                "expected the header 'Authorization: Bearer TOKEN' with the token of this server",
                {"WWW-Authenticate": "Bearer"},
            )

    async def answer(self, request: Request, wish: Wish) -> Response:
        """Return the answer to a request; never raises for what a client did."""
        place = Place(Path(self._temporary.name) / str(next(self._numbers)), self.room)
        try:
            return await self._answer(request, wish, place)
        except Refusal as refusal:
            place.remove()
            return Problem(refusal)
        except ClientDisconnect:
            place.remove()
            self.metrics.abandoned.inc()
            return Response(status_code=_GONE)
        except OSError as error:
            place.remove()
            if not is_full(error):
                raise
            _LOG.error("%s is full", self._temporary.name)
            return Problem(no_room())
        except BaseException:
            place.remove()
            raise

    async def _answer(self, request: Request, wish: Wish, place: Place) -> Response:
        self._admit(max(self.admitted, self.sending))
        place.check(check_headers(request, self.limits).length)
        place.upload.mkdir(parents=True)
        self.sending += 1
        try:
            name = await receive(request, place, self.limits)
        finally:
            self.sending -= 1
        self._admit(self.admitted)
        self.metrics.upload.observe((place.upload / name).stat().st_size)
        done = await self._worked(request, place, name, wish)
        return Result(done, self.limits.send, place.remove)

    def _admit(self, there: int) -> None:
        """Refuse a request that cannot be worked on.

        Args:
            there: Requests that are before it.
        """
        if self.draining:
            raise Refusal(503, "the server is ending; ask another one", dict(RETRY))
        if not self.batcher.alive:
            raise self._failed()
        if there >= self.active + self.limits.queue:
            wait = math.ceil(min(max(self.seconds * self.admitted / self.active, 1), 60))
            raise Refusal(
                503,
                f"{self.limits.queue} requests wait already; try again in {wait} s",
                {"Retry-After": str(wait)},
            )

    async def _worked(self, request: Request, place: Place, name: str, wish: Wish) -> Done:
        """Have a request worked on, until it is done, its time is up or its client goes away."""
        start = time.monotonic()
        ticket = Ticket(start + self.limits.compute)
        self.admitted += 1
        job = self._threads.submit(self._work, place, name, wish, ticket)
        gone = asyncio.ensure_future(_gone(request))
        result = asyncio.wrap_future(job)
        result.add_done_callback(lambda future: future.cancelled() or future.exception())  # it is looked at
        try:
            await asyncio.wait(
                (gone, result), timeout=self.limits.compute, return_when=asyncio.FIRST_COMPLETED
            )
            if result.done():
                done = self._result(result)
                taken = time.monotonic() - start
                self.seconds += 0.2 * (taken - self.seconds)
                self.metrics.latency.observe(taken)
                return done
            if gone.done():
                raise ClientDisconnect
            raise self._late()
        finally:
            gone.cancel()
            ticket.cancel()
            self._finished(job, place)

    def _finished(self, job: Future[Done], place: Place) -> None:
        """Give the place of a request to another one when its thread has stopped."""
        loop = asyncio.get_running_loop()
        ended = job.done() and not job.cancelled() and job.exception() is None

        def free() -> None:
            self.admitted -= 1
            self._give_back()
            if not ended:
                place.remove()

        if job.done() or job.cancel():
            free()
        else:

            def later(job: Future[Done]) -> None:
                with suppress(RuntimeError):  # the loop is closed when the server ends by force
                    loop.call_soon_threadsafe(free)

            job.add_done_callback(later)

    def _result(self, result: asyncio.Future[Done]) -> Done:
        try:
            return result.result()
        except Refusal:
            raise
        except Over:
            raise self._late() from None
        except Failed:
            raise self._failed() from None
        except Exception as error:
            if is_full(error):
                raise no_room() from error
            _LOG.exception("a request failed")
            raise Refusal(500, "the server failed on this request; its log says why") from None

    def _late(self) -> Refusal:
        return Refusal(
            504, f"the result took longer than {self.limits.compute:g} seconds; send smaller or fewer frames"
        )

    def _failed(self) -> Refusal:
        return Refusal(
            503,
            "the server cannot run its model any more and has to be started again; its log says why",
            dict(RETRY),
        )

    def _work(self, place: Place, name: str, wish: Wish, ticket: Ticket) -> Done:
        with self.metrics.active.track_inprogress():
            ticket.check()
            done = self.workshop.work(place, name, wish, ticket)
            self.metrics.megapixels.inc(done.pixels / 1e6)
            return done

    def _give_back(self) -> None:
        """Return freed memory to the system: glibc keeps that of each thread, and more with every size."""
        if self._trim is not None and time.monotonic() - self._trimmed > _TRIM_SECONDS:
            self._trimmed = time.monotonic()
            self._trim(0)


async def _gone(request: Request) -> None:
    """Return when the client went away."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
