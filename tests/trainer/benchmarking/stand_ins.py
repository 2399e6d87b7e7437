"""Processes that measure nothing and answer at once, and outcomes with given figures."""

from __future__ import annotations

import math
import random

from trainer.benchmarking import process
from trainer.benchmarking.cases import Case, Method, Outcome
from trainer.benchmarking.process import MeasuringError

READY = {"first_seconds": 0.5, "megapixels": 0.25, "threads": 2, "device_name": None, "mode": "eager"}


class Stand:
    """Stands for `Measuring`: the time of a call is that of its model, by name, times a lasting factor.

    Class attributes are set by tests: `seconds` of each model, `drift` (spread of the logarithm of a
    process's own factor), `noise` (of every call's), `failing` (model → reason), `calls` made so far.
    """

    seconds: dict[str, float] = {}
    failing: dict[str, str] = {}
    drift = noise = 0.0
    random = random.Random(0)
    calls: list[str] = []

    def __init__(self, root=None, tell=lambda stage: None, timeout=None):
        self.factor = math.exp(self.random.gauss(0, self.drift))
        self.closed = False

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()

    def prepare(self, case, warmup, file=None):
        self.model = case.method.model
        if self.model in self.failing:
            raise MeasuringError(self.failing[self.model])
        return dict(READY)

    def times(self, calls):
        self.calls.append(self.model)
        wait = self.seconds[self.model]
        if isinstance(wait, BaseException):
            raise wait
        return [wait * self.factor * math.exp(self.random.gauss(0, self.noise)) for _ in range(calls)]

    def finish(self):
        return {"peak_bytes": 5_000_000, "others": 0.0}

    def close(self):
        self.closed = True


def script(monkeypatch, text):
    """Let processes that measure run this text instead."""
    monkeypatch.setattr(process, "_START", "import json, os, sys, time\n" + text)


def outcome(model="WSKP", seconds=(0.1, 0.2, 0.3), others=0.0, peak=2e6, **fields):
    case = Case(Method(model), **fields)
    return Outcome(
        case, None, tuple(seconds), 0.5, case.width * case.height / 1e6, int(peak), 2, None, others
    )


def failure(model="WSKP", reason="no such file", **fields):
    return Outcome(Case(Method(model), **fields), reason)
