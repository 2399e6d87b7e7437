"""Tries again while a server is away, says so in one line, and gives up with a message that helps."""

from __future__ import annotations

import os
import random
import sys
import threading
import time
from collections.abc import Callable
from typing import TypeVar
from urllib.parse import urlsplit

from data.progress import duration
from data.remote_failures import ContentError, Judgement, judge

Result = TypeVar("Result")

PATIENCE = "PENUMBRA_REMOTE_PATIENCE"
DEFAULT_PATIENCE_S = 300.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Pauses double from the first to the longest; each is taken at random between half of that and all of it, so
that many processes do not come back at one moment."""
NOTICE_AFTER_S = 2.0
"""A failure that is over sooner is not told."""
CONTENT_ATTEMPTS = 3
"""Downloads of a file that arrives otherwise than it should be: waiting mends nothing there."""
UNKNOWN_HOST_S = 20.0
"""Patience with a host whose name is not known and that this process never reached: most often a typo."""


class NoBucketError(FileNotFoundError):
    """The bucket of a file does not exist, where a missing file would be nothing unusual."""


_lock = threading.Lock()
_reached: set[str] = set()
_told: dict[str, float] = {}


def _renew_lock() -> None:
    """Give a forked process a lock that no thread of its parent holds."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_renew_lock)


def patience_s() -> float:
    """Return for how many seconds a request is tried: `$PENUMBRA_REMOTE_PATIENCE`, by default 300.

    Raises:
        ValueError: The variable is no number of seconds.
    """
    text = os.environ.get(PATIENCE) or str(DEFAULT_PATIENCE_S)
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < float("inf"):
        raise ValueError(f"{PATIENCE} is {text!r}; expected seconds, such as 300, or 0 to try only once")
    return seconds


def patiently(doing: str, url: str, attempt: Callable[[], Result]) -> Result:
    """Return what a request returns; tries again after failures that may pass.

    Args:
        doing: What is tried, for messages: `read`, `write`.
        url: What it is tried on.
        attempt: The request.

    Raises:
        FileNotFoundError: There is no such file; NoBucketError: there is no such bucket.
        PermissionError: Credentials are missing, expired, or do not allow it.
        ConnectionError: The server gave no good answer for as long as the patience lasts.
        OSError: The server refuses the request, or this machine failed, as with a full disk.
        ContentError: Something else arrived than was expected, several times.
    """
    host, began, tries, wrong = _host(url), time.monotonic(), 0, 0
    limit = patience_s()
    while True:
        tries += 1
        try:
            result = attempt()
        except Exception as error:
            judged = judge(error)
            if judged is None:
                raise
            wrong += isinstance(error, ContentError)
            if wrong >= CONTENT_ATTEMPTS:
                raise
            if judged.kind not in ("again", "unknown host"):
                raise _final(doing, url, judged) from error
            with _lock:
                hopeless = judged.kind == "unknown host" and host not in _reached
            waited = time.monotonic() - began
            left = (min(limit, UNKNOWN_HOST_S) if hopeless else limit) - waited
            if left <= 0:
                raise ConnectionError(_given_up(doing, url, judged, tries, waited)) from error
            _tell(host, url, judged, waited, waited + left)
            time.sleep(min(_pause(tries), left))
        else:
            _answers(host)
            return result


def shown(url: str) -> str:
    """Return a URL for messages: without password and without what follows a question mark."""
    parts = urlsplit(url)
    if not parts.netloc:  # a file, such as sqlite:////runs/mlflow.db, which would lose slashes
        return url
    return parts._replace(netloc=parts.netloc.rpartition("@")[2], query="", fragment="").geturl()


def endpoint() -> str | None:
    """Return the address of the S3 server that the environment names; None: Amazon's."""
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or None


def _pause(tries: int) -> float:
    longest = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2 ** min(tries - 1, 10))
    return longest * random.uniform(0.5, 1.0)


def _host(url: str) -> str:
    parts = urlsplit(url)
    if parts.scheme == "s3":
        return f"the S3 server {endpoint()}" if endpoint() else "Amazon S3"
    return parts.netloc.rpartition("@")[2] or parts.scheme


def _tell(host: str, url: str, judged: Judgement, waited: float, limit: float) -> None:
    with _lock:
        if waited < NOTICE_AFTER_S or host in _told:
            return
        _told[host] = time.monotonic() - waited
    print(
        f"note: {host} fails ({judged.reason}; {shown(url)}); trying again for up to {duration(limit)}, "
        f"{PATIENCE} sets the seconds",
        file=sys.stderr,
        flush=True,
    )


def _answers(host: str) -> None:
    with _lock:
        _reached.add(host)
        began = _told.pop(host, None)
    if began is not None:
        text = f"note: {host} answers again after {duration(time.monotonic() - began)}"
        print(text, file=sys.stderr, flush=True)


def _given_up(doing: str, url: str, judged: Judgement, tries: int, waited: float) -> str:
    server = f" ({_host(url)})" if url.startswith("s3:") else ""
    return (
        f"cannot {doing} {shown(url)}{server}: {judged.reason}; tried {tries} times in {duration(waited)}. "
        f"Check the address and the server; {PATIENCE} sets for how many seconds it is tried"
    )


def _final(doing: str, url: str, judged: Judgement) -> OSError:
    """Return the error for a failure that waiting does not mend."""
    what = f"cannot {doing} {shown(url)}: {judged.reason}"
    s3 = url.startswith("s3:")
    server = _host(url)
    if judged.kind == "missing":
        return FileNotFoundError(f"{what}; check the address")
    if judged.kind == "no bucket":
        bucket = urlsplit(url).netloc
        return NoBucketError(
            f"cannot {doing} {shown(url)}: {server} has no bucket {bucket!r}; check the name and "
            "AWS_ENDPOINT_URL, or make the bucket"
        )
    if judged.kind == "expired":
        return PermissionError(
            f"{what}: the credentials have expired; renew AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and "
            "AWS_SESSION_TOKEN, and start the same command again, which continues"
        )
    if judged.kind == "clock":
        return PermissionError(f"{what}: the clock of this machine and that of {server} differ; set it")
    if judged.kind == "refused":
        advice = (
            f"check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_ENDPOINT_URL ({server}), and what they "
            "may do"
            if s3
            else "the server does not allow it; check the address and the credentials in it"
        )
        return PermissionError(f"{what}; {advice}")
    if judged.kind == "here":
        return OSError(f"{what}; make room or check permissions on this machine")
    return OSError(f"{what}; the server does not accept the request, trying again would not help")
