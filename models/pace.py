"""How far a long computation has come: steps that operations report, and the share of the time they take.

Non-local means and regressions visit hundreds of window offsets, some far dearer than others. `Pace` runs the
same computation on a small image first and learns when each step comes.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_listeners: list[Callable[[float], None]] = []


def tick(share: float) -> None:
    """Report a step to whoever listens.

    Args:
        share: The part of the image's rows that it was for, so that steps add up to the same number for every
            image.
    """
    for listener in _listeners:
        listener(share)


@contextmanager
def listening(listener: Callable[[float], None]) -> Iterator[None]:
    """Call `listener` with each step while the block runs."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


class Pace:
    """When the steps of a computation come.

    Args:
        sample: Does the same computation on less.
    """

    def __init__(self, sample: Callable[[], Any]) -> None:
        self._steps, self._times = [0.0], [0.0]
        start = time.perf_counter()

        def note(share: float) -> None:
            self._steps.append(self._steps[-1] + share)
            self._times.append(time.perf_counter() - start)

        with listening(note):
            sample()

    def share(self, steps: float) -> float:
        """Return the share of the time, 0 to 1, at which so many steps are done; 0 where none are known."""
        place = bisect_right(self._steps, steps) - 1
        return self._times[place] / self._times[-1] if self._times[-1] > 0 else 0.0
