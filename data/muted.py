"""Keeps a library quiet that prints where it should raise, without touching what other threads print."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_lock = threading.Lock()
_muted: Counter[int] = Counter()


class _Output:
    """Standard output without what muted threads print."""

    def __init__(self, real: Any) -> None:
        self.real = real

    def write(self, text: str) -> int:
        """Write, or do not."""
        return len(text) if threading.get_ident() in _muted else self.real.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)


@contextmanager
def muted() -> Iterator[None]:
    """Drop what this thread prints to `sys.stdout`.

    `contextlib.redirect_stdout` drops what all threads print, and where two of them leave it in the order in
    which they came, standard output is lost for good.
    """
    thread = threading.get_ident()
    with _lock:
        if not _muted and not isinstance(sys.stdout, _Output):
            sys.stdout = _Output(sys.stdout)
        _muted[thread] += 1
    try:
        yield
    finally:
        with _lock:
            _muted[thread] -= 1
            if not _muted[thread]:
                del _muted[thread]
            if not _muted and isinstance(sys.stdout, _Output):
                sys.stdout = sys.stdout.real
