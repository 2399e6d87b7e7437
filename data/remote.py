"""Files at a URL: read whole, in part or not at all, and written, on S3 and over HTTP.

`s3://bucket/path` is configured by the usual variables (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,
AWS_SESSION_TOKEN, AWS_ENDPOINT_URL, AWS_REGION) or the files of the AWS command line. `http://` and
`https://` are read from any server; for writing it has to take PUT, as WebDAV servers do. `memory://` and
`file://` are for tests. All calls block; they may be used from any thread, and in forked processes, each of
which makes connections of its own.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from data.remote_failures import ContentError
from data.remote_patience import endpoint, patiently, shown

SCHEMES = ("s3", "http", "https", "memory", "file")
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 10, 30
"""Longest waits for a connection, and for the next piece of an answer."""
SHA256 = "penumbra-sha256"
"""Name under which S3 keeps the checksum of what was sent."""
PIECE = 1 << 23
"""Bytes of an S3 file that are read in one request; up to `TOGETHER` of them at one time, so 32 MiB of memory."""
TOGETHER = 4

_lock = threading.Lock()
_systems: dict[tuple[Any, ...], Any] = {}


def is_url(text: str | Path) -> bool:
    """Return whether a text names a file or folder at a URL, rather than on this machine."""
    scheme, colon, _ = str(text).partition("://")
    return bool(colon) and scheme.lower() in SCHEMES


def url_of(text: str | Path) -> str | None:
    """Return the URL of a folder that was named, without slashes at its end; None: it is a path.

    Raises:
        ValueError: It begins as a URL does, but lacks the bucket or host, or the scheme is not known.
    """
    named = str(text)
    scheme = named.partition(":")[0].lower()
    if "://" not in named and (scheme not in SCHEMES or ":" not in named):
        return None
    rest = named.partition("://")[2]
    if not is_url(named) or not rest.strip("/"):
        raise ValueError(f"{named} is no address of a folder; expected s3://BUCKET/PATH or https://HOST/PATH")
    parts = urlsplit(named)
    return parts._replace(scheme=scheme, path=parts.path.rstrip("/")).geturl()


def join(url: str, name: str) -> str:
    """Return the URL of a file in the folder at `url`; what follows a question mark stays behind it."""
    parts = urlsplit(url)
    return parts._replace(path=f"{parts.path.rstrip('/')}/{name}").geturl()


def fetch(
    url: str,
    path: Path,
    *,
    size: int | None = None,
    sha256: str | None = None,
    report: Callable[[int], None] | None = None,
) -> None:
    """Download a file, whole or not at all: it appears under its name when everything has been checked.

    Args:
        url: What.
        path: Where to; replaced if it exists.
        size: Bytes that it must have.
        sha256: Checksum that it must have, in hexadecimal.
        report: Called with the number of bytes of each piece as it arrives.

    Raises:
        ValueError: It arrived three times with another size or checksum.
        OSError: As `data.remote_patience.patiently`.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.partial")
    try:
        download(url, temporary, size=size, sha256=sha256, report=report)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def download(
    url: str,
    path: Path,
    *,
    size: int | None = None,
    limit: int | None = None,
    sha256: str | None = None,
    report: Callable[[int], None] | None = None,
) -> None:
    """Download into a file that is written directly; otherwise as `fetch`.

    `limit` is the largest number of bytes that is taken; by default `size`.
    """
    limit = size if limit is None else limit

    def attempt() -> None:
        _system(url).get_file(_inner(url), str(path), callback=_counter(limit, report))
        _check(path, size, sha256)

    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"{path.parent} does not exist; make the folder that {shown(url)} is read into"
        )
    try:
        patiently("read", url, attempt)
    except ContentError as error:
        raise ValueError(
            f"{shown(url)} is not what it should be: {error}; it was read several times"
        ) from error


def read_bytes(url: str, limit: int) -> bytes:
    """Return a small file.

    Args:
        url: What.
        limit: Largest number of bytes; no more are read.

    Raises:
        ValueError: It is larger.
        OSError: As `fetch`.
    """
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        path = Path(folder) / "file"
        download(url, path, limit=limit)
        return path.read_bytes()


def read_range(url: str, start: int, size: int) -> bytes | None:
    """Return `size` bytes from `start` on; None where the server gives whole files only.

    Raises:
        ValueError: Fewer bytes arrived, three times.
        OSError: As `fetch`.
    """

    def attempt() -> bytes | None:
        system = _system(url)
        if _is_http(url):
            data: bytes | None = _run(system, _http_range(system, url, start, size))
        else:
            data = system.cat_file(_inner(url), start=start, end=start + size)
        if data is not None and len(data) != size:
            raise ContentError(f"{len(data)} bytes arrived from byte {start} on, expected {size}")
        return data

    try:
        return patiently("read", url, attempt)
    except ContentError as error:
        raise ValueError(f"{shown(url)} is not what it should be: {error}") from error


def send(path: Path, url: str, *, report: Callable[[int], None] | None = None) -> None:
    """Upload a file; on S3 it appears whole or not at all, and its checksum is kept beside it.

    Args:
        path: What.
        url: Where to; replaced if it exists. Over HTTP by PUT.
        report: Called with the number of bytes of each piece as it leaves; again where it is tried again.

    Raises:
        OSError: As `fetch`, or the file cannot be read.
    """
    size = path.stat().st_size
    digest = file_sha256(path)
    options: dict[str, Any] = {}
    if url.startswith("s3:"):
        options["Metadata"] = {SHA256: digest}
    elif _is_http(url):
        options["method"] = "put"

    def attempt() -> None:
        system = _system(url)
        if not options:
            system.makedirs(system._parent(_inner(url)), exist_ok=True)
        system.put_file(str(path), _inner(url), callback=_counter(None, report), **options)
        there = _size(url)
        if there != size:
            raise ContentError(f"{size} bytes were sent and {there} are there")

    try:
        patiently("write", url, attempt)
    except ContentError as error:
        raise OSError(f"cannot write {shown(url)}: {error}, several times; check the server") from error


def exists(url: str) -> bool:
    """Return whether there is a file at a URL.

    Raises:
        OSError: As `fetch`, except that a missing file is no error; a missing bucket may be.
    """
    try:
        size_of(url)
    except FileNotFoundError as error:
        if "no bucket" in str(error):
            raise
        return False
    return True


def size_of(url: str) -> int | None:
    """Return the bytes of a file, None where the server does not say.

    Raises:
        OSError: As `fetch`.
    """
    return patiently("read", url, lambda: _size(url))


def _size(url: str) -> int | None:
    system = _system(url)
    system.invalidate_cache()
    found = system.info(_inner(url))
    if found.get("type") == "directory":
        raise FileNotFoundError(f"{shown(url)} is a folder")
    return None if found.get("size") is None else int(found["size"])


def sha256_of(url: str) -> str | None:
    """Return the checksum of a file at a URL: what S3 keeps beside it, elsewhere by reading it.

    None: S3 has the file, but it was not sent by `send`.

    Raises:
        OSError: As `fetch`.
    """
    if url.startswith("s3:"):
        found: Any = patiently("read", url, lambda: _system(url).metadata(_inner(url), refresh=True))
        return {str(name).lower(): str(value) for name, value in found.items()}.get(SHA256)
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        download(url, Path(folder) / "file")
        return file_sha256(Path(folder) / "file")


def listing(url: str) -> dict[str, int] | None:
    """Return the files directly in a folder with their sizes; None where that cannot be asked (HTTP).

    Raises:
        FileNotFoundError: There is no such bucket; a folder that does not exist is empty.
        OSError: As `fetch`.
    """
    if _is_http(url):
        return None

    def attempt() -> list[dict[str, Any]]:
        system = _system(url)
        system.invalidate_cache()
        if url.startswith("s3:"):  # a folder without files is no error, a missing bucket is
            system.call_s3("list_objects_v2", Bucket=urlsplit(url).netloc, MaxKeys=1)
        try:
            return list(system.ls(_inner(url), detail=True))
        except FileNotFoundError:
            return []

    found = patiently("read", url, attempt)
    files = {e["name"].rpartition("/")[2]: int(e["size"] or 0) for e in found if e["type"] == "file"}
    files.pop("", None)  # some stores keep an empty object for a folder
    return files


def remove(url: str) -> None:
    """Remove a file; it may be missing.

    Raises:
        OSError: As `fetch`.
    """

    def attempt() -> None:
        system = _system(url)
        if _is_http(url):
            _run(system, _http_delete(system, url))
        else:
            system.rm_file(_inner(url))

    with contextlib.suppress(FileNotFoundError):
        patiently("remove", url, attempt)


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file on this machine in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_http(url: str) -> bool:
    return url.startswith(("http:", "https:"))


def _inner(url: str) -> str:
    """Return what the file system calls a file: S3 without scheme, where `?` would begin a version."""
    return url.partition("://")[2] if url.startswith("s3:") else url


def _system(url: str) -> Any:
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


def _counter(limit: int | None, report: Callable[[int], None] | None) -> Any:
    """Return what counts the pieces of a transfer, and ends it where there are too many."""
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


def _check(path: Path, size: int | None, sha256: str | None) -> None:
    found = path.stat().st_size
    if size is not None and found != size:
        raise ContentError(f"{found} bytes arrived, expected {size}")
    if sha256 is not None:
        digest = file_sha256(path)
        if digest != sha256:
            raise ContentError(f"its checksum is {digest[:12]}…, expected {sha256[:12]}…")


def _run(system: Any, coroutine: Any) -> Any:
    from fsspec.asyn import sync

    return sync(system.loop, lambda: coroutine)


async def _http_range(system: Any, url: str, start: int, size: int) -> bytes | None:
    session = await system.set_session()
    headers = {"Range": f"bytes={start}-{start + size - 1}", "Accept-Encoding": "identity"}
    async with session.get(system.encode_url(url), headers=headers) as answer:
        answer.raise_for_status()
        if answer.status != 206:
            return None
        data: bytes = await answer.content.readexactly(size)
        return data


async def _http_delete(system: Any, url: str) -> None:
    session = await system.set_session()
    async with session.delete(system.encode_url(url)) as answer:
        answer.raise_for_status()
