"""Progress of work that is counted: rate and remaining time, as plain lines."""

from __future__ import annotations

import sys
import time

from data.alive import touch


def duration(seconds: float) -> str:
    """Return a time span such as `1:02:03` or `4:05`."""
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    text = f"{rest // 60}:{rest % 60:02d}" if hours == 0 else f"{hours}:{rest // 60:02d}:{rest % 60:02d}"
    return text


def size_text(number: int) -> str:
    """Return bytes as `12 MB` or `3.4 GB`."""
    return f"{number / 1e9:.1f} GB" if number >= 1e9 else f"{number / 1e6:.0f} MB"


class Rate:
    """Samples per second and time left since the first call; samples of an earlier run do not count.

    Args:
        unit: What is counted.
    """

    def __init__(self, unit: str = "samples") -> None:
        self.unit = unit
        self._start: tuple[float, int] | None = None

    def per_second(self, done: int) -> float:
        """Return the samples per second since the first call, 0 at that call."""
        now = time.monotonic()
        if self._start is None:
            self._start = (now, done)
        begun, before = self._start
        return (done - before) / (now - begun) if now > begun else 0.0

    def text(self, done: int, total: int) -> str:
        """Return `12/80 samples, 34.5/s, 0:02 left`."""
        rate = self.per_second(done)
        text = f"{done}/{total} {self.unit}"
        if rate > 0 and done < total:
            text += f", {rate:.1f}/s, {duration((total - done) / rate)} left"
        return text


class LineProgress:
    """Prints a line to standard error at the start, then at most every ten seconds, and at the end.

    Args:
        title: Beginning of each line.
        interval: Seconds between lines.
        unit: What is counted.
    """

    def __init__(self, title: str, interval: float = 10.0, unit: str = "samples") -> None:
        self.title, self.interval = title, interval
        self._rate = Rate(unit)
        self._last: float | None = None

    def __call__(self, done: int, total: int) -> None:
        """Report that `done` of `total` samples are finished."""
        touch()
        text = self._rate.text(done, total)
        now = time.monotonic()
        if self._last is None or now - self._last >= self.interval or done == total:
            self._last = now
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)
