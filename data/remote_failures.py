"""What a failed request means: wait and try again, or tell, and how.

Servers and libraries report one thing in many ways. It is judged by the HTTP status and the code of S3 at the
bottom of an exception, and by its class where there was no answer. Classes are known by name, since the
libraries are imported only where they are used.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

Kind = Literal[
    "again", "unknown host", "missing", "no bucket", "expired", "clock", "refused", "wrong", "here"
]
"""`again`: a later attempt may succeed; `refused`: credentials are missing or do not allow it; `wrong`: the
server does not accept the request; `here`: this machine failed, as with a full disk."""


class Judgement(NamedTuple):
    """What to do about a failure, and what it was, in a few words."""

    kind: Kind
    reason: str


EXPIRED = {"ExpiredToken", "ExpiredTokenException", "TokenRefreshRequired", "RequestExpired"}
BUSY = {"SlowDown", "Throttling", "ThrottlingException", "RequestLimitExceeded", "TooManyRequests"}
BUSY |= {"RequestTimeout", "InternalError", "ServiceUnavailable", "IncompleteBody", "OperationAborted"}
CLOCK = {"RequestTimeTooSkewed", "RequestInTheFuture"}
REFUSED = {"AccessDenied", "InvalidAccessKeyId", "SignatureDoesNotMatch", "InvalidToken", "AllAccessDisabled"}
NO_CREDENTIALS = {"NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError"}
NO_CREDENTIALS |= {"TokenRetrievalError", "UnauthorizedSSOTokenError", "ProfileNotFound"}
NO_ANSWER = {
    *("EndpointConnectionError", "ConnectionClosedError", "ConnectTimeoutError", "ReadTimeoutError"),
    *("HTTPClientError", "ProxyConnectionError", "IncompleteReadError", "ResponseStreamingError"),
    *("ClientConnectionError", "ClientPayloadError", "ServerTimeoutError", "FSTimeoutError"),
    *("IncompleteRead", "FlexibleChecksumError", "AioHttpIncompleteRead", "AioReadTimeoutError"),
}
LOCAL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EMFILE, errno.ENFILE, errno.EFBIG}


class ContentError(Exception):
    """What arrived is not what was expected: cut, too long, or with another checksum."""


def judge(error: BaseException) -> Judgement | None:
    """Return what an exception of a request means; None: it is none of a request, but a bug."""
    chain = list(_causes(error))
    for found in chain:
        judged = _answered(found)
        if judged is not None:
            return judged
    for found in chain[::-1]:
        judged = _unanswered(found)
        if judged is not None:
            return judged
    return Judgement("wrong", _text(error)) if isinstance(error, OSError) else None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        inner = getattr(error, "os_error", None) or _arguments(error).get("error")  # aiohttp, botocore
        error = error.__cause__ or (inner if isinstance(inner, BaseException) else None)


def _arguments(error: BaseException) -> dict[str, Any]:
    found = getattr(error, "kwargs", None)
    return found if isinstance(found, dict) else {}


def _answered(error: BaseException) -> Judgement | None:
    """Judge an answer of the server: the code of S3 and the status of HTTP."""
    code, status, said = "", getattr(error, "status", None), ""
    response: Any = getattr(error, "response", None)
    if isinstance(response, dict):
        told = response.get("Error") or {}
        code, said = str(told.get("Code", "")), str(told.get("Message", ""))
        status = (response.get("ResponseMetadata") or {}).get("HTTPStatusCode", status)
    if not isinstance(status, int):
        status = int(code) if code.isdigit() else 0
    if not status and not code:
        return None
    reason = ", ".join(filter(None, (f"status {status}" if status else "", said or code)))
    return Judgement(_kind(code, status), reason)


def _kind(code: str, status: int) -> Kind:
    if code in EXPIRED:
        return "expired"
    if code in CLOCK:
        return "clock"
    if code == "NoSuchBucket":
        return "no bucket"
    if code in BUSY or status >= 500 or status in (408, 425, 429):
        return "again"
    if code in REFUSED or status in (401, 403):
        return "refused"
    if status in (404, 410) or code == "NoSuchKey":
        return "missing"
    return "wrong"


def _unanswered(error: BaseException) -> Judgement | None:
    """Judge an exception that is no answer of a server."""
    names = {cls.__name__ for cls in type(error).__mro__}
    if names & NO_CREDENTIALS:
        return Judgement("refused", "no credentials were found")
    if isinstance(error, socket.gaierror) or "ClientConnectorDNSError" in names:
        unknown = getattr(error, "errno", None) == socket.EAI_NONAME
        return Judgement("unknown host" if unknown else "again", "the name of the host is not known")
    if isinstance(error, OSError) and error.errno in LOCAL:
        return Judgement("here", error.strerror or str(error))
    if isinstance(error, ContentError | ConnectionError | TimeoutError | EOFError) or names & NO_ANSWER:
        return Judgement("again", _text(error))
    if isinstance(error, FileNotFoundError):
        return Judgement("missing", "there is no such file")
    if isinstance(error, PermissionError | IsADirectoryError | NotADirectoryError):
        return Judgement("here" if error.filename else "refused", _text(error))
    return None


def _text(error: BaseException) -> str:
    if isinstance(error, ConnectionRefusedError) or getattr(error, "errno", None) == errno.ECONNREFUSED:
        return "connection refused"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    number = error.errno if isinstance(error, OSError) else None
    if number is not None and number in errno.errorcode and number > 0:
        return os.strerror(number).lower()
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
