"""Why a tracking store did not take something, and what to do about it."""

from __future__ import annotations

import enum
import re


class Kind(enum.Enum):
    """What helps: waiting, mending the credentials, or nothing."""

    AWAY = "away"
    DENIED = "denied"
    REFUSED = "refused"


DENIED = ("UNAUTHENTICATED", "CUSTOMER_UNAUTHORIZED", "PERMISSION_DENIED")
REFUSED = ("INVALID_PARAMETER_VALUE", "BAD_REQUEST", "RESOURCE_ALREADY_EXISTS", "RESOURCE_DOES_NOT_EXIST")
SURROUNDINGS = ("requests", "urllib3", "sqlalchemy", "alembic", "sqlite3", "psycopg", "boto3", "botocore",
                "s3transfer", "azure", "google")  # fmt: skip
"""Packages whose exceptions tell of servers and databases."""
TRANSPORT = "API request to"
"""How MLflow begins its messages about answers that are not those of an MLflow server."""
REASONS = (
    (r"too many (\d+) error responses", r"HTTP status \1"),
    (r"failed with error code (\d+)", r"HTTP status \1"),
    (r"(\d{3}) (?:Client|Server) Error", r"HTTP status \1"),
    (r"Connection refused", "connection refused"),
    (r"Connection reset|Connection aborted|RemoteDisconnected", "connection lost"),
    (r"NameResolutionError|Failed to resolve|Name or service not known", "unknown host"),
    (r"[Tt]imed out|timeout", "no answer in time"),
    (r"database is locked", "the database is locked"),
    (r"disk is full|No space left", "its disk is full"),
)


class OutageError(Exception):
    """Nothing can be sent at present.

    Args:
        kind: Whether waiting helps or credentials do.
        reason: A few words.
    """

    def __init__(self, kind: Kind, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
        self.reason = reason


class RefusedError(Exception):
    """The store will never take this."""


def classify(error: Exception) -> Kind:
    """Return what kind of failure an exception of MLflow, HTTP, a database or the file system is."""
    from mlflow.exceptions import InvalidUrlException, MlflowException
    from requests import HTTPError

    if isinstance(error, InvalidUrlException):
        return Kind.AWAY
    if isinstance(error, MlflowException):
        if error.error_code in DENIED:
            return Kind.DENIED
        # An answer without MLflow's own words is a proxy's: it refuses a request, not what was recorded.
        foreign = TRANSPORT in str(error)
        return Kind.REFUSED if error.error_code in REFUSED and not foreign else Kind.AWAY
    if isinstance(error, HTTPError) and error.response is not None:
        status = error.response.status_code
        if status in (401, 403):
            return Kind.DENIED
        return Kind.REFUSED if status == 413 or (status == 400 and _worded(error)) else Kind.AWAY
    if isinstance(error, FileNotFoundError):
        return Kind.REFUSED
    waiting = isinstance(error, (OSError, ImportError, MemoryError))
    # What is no failure of the surroundings lies in the entry itself, and stays.
    return Kind.AWAY if waiting or type(error).__module__.split(".")[0] in SURROUNDINGS else Kind.REFUSED


def _worded(error: object) -> bool:
    return '"error_code"' in str(error)


def reason(error: Exception) -> str:
    """Return an exception in a few words."""
    text = str(error)
    for pattern, words in REASONS:
        found = re.search(pattern, text)
        if found:
            return found.expand(words)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    line = next((line for line in lines if not line.startswith("(raised as a result of")), "")
    return line[:200] or type(error).__name__
