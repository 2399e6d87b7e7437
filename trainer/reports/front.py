"""The Pareto front of two numbers, such as an error and a time."""

from __future__ import annotations

from collections.abc import Sequence


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each point whether no other beats it: is as small in both numbers, and smaller in one."""
    return [not any(p != q and p[0] <= q[0] and p[1] <= q[1] for p in points) for q in points]
