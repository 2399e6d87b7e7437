"""A clock around functions of the package: what each of them takes of a call, without those inside it."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

Named = str | Callable[..., str]
"""A step's name, or what makes it out of the function's arguments."""


class Clock:
    """Processor seconds of steps.

    Attributes:
        seconds: Of each step, those of steps inside it left out.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside: list[float] = []

    def around(self, function: Callable[..., Any], named: Named) -> Callable[..., Any]:
        """Return the function with a clock around it."""

        def clocked(*arguments: Any, **options: Any) -> Any:
            name = named if isinstance(named, str) else named(*arguments, **options)
            self._inside.append(0.0)
            began = time.process_time()
            made = function(*arguments, **options)
            took = time.process_time() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + took - self._inside.pop()
            if self._inside:
                self._inside[-1] += took
            return made

        return clocked


@contextmanager
def clocked(steps: Mapping[str, Named]) -> Iterator[Clock]:
    """Put a clock around functions while the block runs.

    Args:
        steps: Where functions are looked up when they are called, such as `models.classical.nlm.nlm_filter`
            or `models.classical.svgf.SVGF._filtered`, and what they are called in the table.
    """
    clock = Clock()
    with ExitStack() as stack:
        for path, name in steps.items():
            owner, _, attribute = path.rpartition(".")
            target = _found(owner)
            function = clock.around(getattr(target, attribute), name)
            stack.enter_context(patch.object(target, attribute, function))
        yield clock


def _found(path: str) -> Any:
    """Return a module, or a class of one."""
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        module, _, name = path.rpartition(".")
        return getattr(importlib.import_module(module), name)
