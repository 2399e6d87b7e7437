"""The file systems behind URLs: S3 and HTTP through fsspec, imported on first use, made in each process."""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable
from typing import Any

from data.remote_failures import ContentError
from data.remote_patience import endpoint

CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 10, 30
"""Longest waits for a connection, and for the next piece of an answer."""
PIECE, TOGETHER = 1 << 23, 4
"""Bytes of an S3 file in one request, and requests at one time: a download takes 32 MiB of memory."""

_lock = threading.Lock()
_systems: dict[tuple[Any, ...], Any] = {}


def _renew_lock() -> None:
    """Give a forked process a lock that no thread of its parent holds."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_renew_lock)


def is_http(url: str) -> bool:
    """Return whether a URL is read over HTTP."""
    return url.startswith(("http:", "https:"))


def inner(url: str) -> str:
    """Return what the file system calls a file: S3 without scheme, where `?` would begin a version."""
    return url.partition("://")[2] if url.startswith("s3:") else url


def system_of(url: str) -> Any:
    """Return the file system of a URL, made once in each process.

    Its connections are served by a thread, which a forked process does not have.
    """
    scheme = url.partition("://")[0]
    key = (os.getpid(), scheme, endpoint() if scheme == "s3" else None)
    with _lock:
        if key not in _systems:
            _systems[key] = _make(scheme)
        return _systems[key]


def _make(scheme: str) -> Any:
    needed = {"s3": "s3fs", "http": "aiohttp", "https": "aiohttp"}.get(scheme, "fsspec")
    if importlib.util.find_spec(needed) is None:
        raise ValueError(f'{scheme}:// needs the package {needed}: pip install "penumbra-denoise[remote]"')
    import fsspec

    options: dict[str, Any] = {"skip_instance_cache": True}
    if scheme == "s3":
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
        client: dict[str, Any] = {"region_name": region} if region else {}
        if endpoint():
            client["endpoint_url"] = endpoint()
        config: dict[str, Any] = {
            "connect_timeout": CONNECT_TIMEOUT_S,
            "read_timeout": READ_TIMEOUT_S,
            "retries": {"total_max_attempts": 1},  # `patiently` tries again
        }
        if endpoint():  # stores of one's own rarely have a host name for each bucket
            config["s3"] = {"addressing_style": "path"}
        options |= {"client_kwargs": client, "config_kwargs": config, "use_listings_cache": False}
        options |= {"default_block_size": PIECE, "max_concurrency": TOGETHER}
    elif scheme in ("http", "https"):
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_TIMEOUT_S, sock_read=READ_TIMEOUT_S)
        options |= {
            "client_kwargs": {"timeout": timeout, "trust_env": True},
            "headers": {"Accept-Encoding": "identity"},
        }
    system = fsspec.filesystem(scheme, **options)
    if scheme == "s3":
        system.retries = 1
    return system


def counter(limit: int | None, report: Callable[[int], None] | None) -> Any:
    """Return what counts the bytes of a transfer, and ends it with a ContentError above the limit."""
    from fsspec.callbacks import Callback

    class Counter(Callback):
        def set_size(self, size: int | None) -> None:
            super().set_size(size)
            if limit is not None and size is not None and size > limit:
                raise ContentError(f"it has {size} bytes, expected at most {limit}")

        def relative_update(self, inc: int = 1) -> None:
            super().relative_update(inc)
            if report is not None:
                report(inc)
            if limit is not None and self.value > limit:
                raise ContentError(f"it has more than {limit} bytes")

    return Counter()


def run(system: Any, coroutine: Any) -> Any:
    """Wait for a coroutine on the thread of a file system, and return its result."""
    from fsspec.asyn import sync

    return sync(system.loop, lambda: coroutine)


async def http_range(system: Any, url: str, start: int, size: int) -> bytes | None:
    """Return a part of a file; None where the server gives whole files only."""
    session = await system.set_session()
    headers = {"Range": f"bytes={start}-{start + size - 1}", "Accept-Encoding": "identity"}
    async with session.get(system.encode_url(url), headers=headers) as answer:
        answer.raise_for_status()
        if answer.status != 206:
            return None
        data: bytes = await answer.content.readexactly(size)
        return data


async def http_delete(system: Any, url: str) -> None:
    """Remove a file."""
    session = await system.set_session()
    async with session.delete(system.encode_url(url)) as answer:
        answer.raise_for_status()
