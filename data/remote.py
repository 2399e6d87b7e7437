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
import os
import socket
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from data.remote_failures import ContentError
from data.remote_patience import NoBucketError, patiently, shown
from data.remote_systems import counter, http_delete, http_range, inner, is_http, run, system_of

SCHEMES = ("s3", "http", "https", "memory", "file")
SHA256 = "penumbra-sha256"
"""Name under which S3 keeps the checksum of what was sent."""


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
        system_of(url).get_file(inner(url), str(path), callback=counter(limit, report))
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
        system = system_of(url)
        if is_http(url):
            data: bytes | None = run(system, http_range(system, url, start, size))
        else:
            data = system.cat_file(inner(url), start=start, end=start + size)
        if data is not None and len(data) != size:
            raise ContentError(f"{len(data)} bytes arrived from byte {start} on, expected {size}")
        return data

    try:
        return patiently("read", url, attempt)
    except ContentError as error:
        raise ValueError(f"{shown(url)} is not what it should be: {error}") from error


def send(path: Path, url: str, *, report: Callable[[int], None] | None = None) -> None:
    """Upload a file; on S3 and in a folder it appears whole or not at all.

    On S3 its checksum is kept beside it.

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
    elif is_http(url):
        options["method"] = "put"
    # One name for all tries of a machine, so that what a kill left is overwritten and does not pile up.
    target = f"{url}.{socket.gethostname()}.partial" if url.startswith("file:") else url

    def attempt() -> None:
        system = system_of(url)
        if not options:
            system.makedirs(system._parent(inner(url)), exist_ok=True)
        system.put_file(str(path), inner(target), callback=counter(None, report), **options)
        if target != url:
            system.mv(inner(target), inner(url))
        there = _size(url)
        if there != size:
            raise ContentError(f"{size} bytes were sent and {there} are there")

    try:
        patiently("write", url, attempt)
    except ContentError as error:
        raise OSError(f"cannot write {shown(url)}: {error}, several times; check the server") from error
    except OSError:
        if target != url:
            with contextlib.suppress(OSError):  # on a full disk it would keep its space
                system_of(url).rm_file(inner(target))
        raise


def exists(url: str) -> bool:
    """Return whether there is a file at a URL.

    Raises:
        OSError: As `fetch`, except that a missing file is no error; NoBucketError where the server tells.
    """
    try:
        size_of(url)
    except NoBucketError:
        raise
    except FileNotFoundError:
        return False
    return True


def size_of(url: str) -> int | None:
    """Return the bytes of a file, None where the server does not say.

    Raises:
        OSError: As `fetch`.
    """
    return patiently("read", url, lambda: _size(url))


def _size(url: str) -> int | None:
    system = system_of(url)
    system.invalidate_cache()
    found = system.info(inner(url))
    if found.get("type") == "directory":
        raise FileNotFoundError(f"{shown(url)} is a folder")
    return None if found.get("size") is None else int(found["size"])


def sha256_of(url: str, size: int) -> str | None:
    """Return the checksum of a file at a URL: what S3 keeps beside it, elsewhere by reading it.

    Args:
        url: Of the file.
        size: Bytes that it should have; no more are read.

    Returns:
        None: The file is larger, or S3 has it, but it was not sent by `send`.

    Raises:
        OSError: As `fetch`.
    """
    if url.startswith("s3:"):
        found: Any = patiently("read", url, lambda: system_of(url).metadata(inner(url), refresh=True))
        return {str(name).lower(): str(value) for name, value in found.items()}.get(SHA256)
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        try:
            download(url, Path(folder) / "file", limit=size)
        except ValueError:
            return None
        return file_sha256(Path(folder) / "file")


def listing(url: str) -> dict[str, int] | None:
    """Return the files directly in a folder with their sizes; None where that cannot be asked (HTTP).

    Raises:
        FileNotFoundError: There is no such bucket; a folder that does not exist is empty.
        OSError: As `fetch`.
    """
    if is_http(url):
        return None

    def attempt() -> list[dict[str, Any]]:
        system = system_of(url)
        system.invalidate_cache()
        if url.startswith("s3:"):  # a folder without files is no error, a missing bucket is
            system.call_s3("list_objects_v2", Bucket=urlsplit(url).netloc, MaxKeys=1)
        try:
            return list(system.ls(inner(url), detail=True))
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
        system = system_of(url)
        if is_http(url):
            run(system, http_delete(system, url))
        else:
            system.rm_file(inner(url))

    with contextlib.suppress(FileNotFoundError):
        patiently("remove", url, attempt)


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file on this machine in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(path: Path, size: int | None, sha256: str | None) -> None:
    found = path.stat().st_size
    if size is not None and found != size:
        raise ContentError(f"{found} bytes arrived, expected {size}")
    if sha256 is not None:
        digest = file_sha256(path)
        if digest != sha256:
            raise ContentError(f"its checksum is {digest[:12]}…, expected {sha256[:12]}…")
