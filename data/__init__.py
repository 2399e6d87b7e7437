"""Frames, files and shards. Names that need Lightning are loaded on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data.module import Shards as Shards

__all__ = ["Shards"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from data import module

        return getattr(module, name)
    raise AttributeError(f"module 'data' has no attribute {name!r}")
