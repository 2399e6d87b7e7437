"""What several metrics of one pair of images have in common, computed once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

T = TypeVar("T")
_KEPT: ContextVar[dict[tuple[Any, ...], tuple[Any, Any]] | None] = ContextVar("kept", default=None)


@contextmanager
def shared() -> Iterator[None]:
    """Let metrics share what they make of the same tensors meanwhile, which nobody may change."""
    token = _KEPT.set({})
    try:
        yield
    finally:
        _KEPT.reset(token)


def kept(function: Callable[..., T]) -> Callable[..., T]:
    """Keep the results of a function of tensors and numbers within `shared`; elsewhere compute each time."""

    @wraps(function)
    def call(*arguments: Any) -> T:
        found = _KEPT.get()
        if found is None:
            return function(*arguments)
        key = (function, *(a if isinstance(a, (int, float, str)) else id(a) for a in arguments))
        if key not in found:
            found[key] = arguments, function(*arguments)  # arguments stay, so that no other gets their id
        result: T = found[key][1]
        return result

    return call
