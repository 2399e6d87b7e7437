"""Progress of work that is counted in samples or frames: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from data.alive import touch
from data.progress import Rate, duration

INTERVAL = 15.0
"""Seconds between plain lines."""

SLOW = 10.0
"""Seconds after which a frame counts as slow, and at least every so often its progress is told."""


class SampleRate(Rate):
    """Describes progress as millions of samples, their rate, and the time left."""

    def text(self, done: int, total: int) -> str:
        """Return `12.3/80.0 M samples, 0.35 M/s, 3:13 left`; small amounts in thousands."""
        rate = self.per_second(done)
        unit, letter = (1e6, "M") if total >= 1e6 else (1e3, "k")
        text = f"{done / unit:.1f}/{total / unit:.1f} {letter} samples"
        if rate > 0:
            text += f", {rate / unit:.2g} {letter}/s"
            if done < total:
                text += f", {duration((total - done) / rate)} left"
        return text


@contextmanager
def sample_progress(title: str) -> Iterator[Callable[[int, int, str], None]]:
    """Yield a callback for samples done, samples in all and a label.

    Args:
        title: Beginning of the line.
    """
    rate = SampleRate()
    if not sys.stderr.isatty():
        yield _lines(title, rate)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        TextColumn("{task.fields[text]}"),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", text="")

        def update(done: int, total: int, label: str) -> None:
            touch()
            bar.update(task, completed=done, total=total, text=rate.text(done, total), description=label)

        yield update


def _lines(title: str, rate: SampleRate) -> Callable[[int, int, str], None]:
    last = [-INTERVAL]

    def update(done: int, total: int, label: str) -> None:
        touch()
        text = rate.text(done, total)
        now = time.monotonic()
        if now - last[0] >= INTERVAL or done == total:
            last[0] = now
            print(f"{title}: {text} ({label})", file=sys.stderr, flush=True)

    return update


class Heard(Protocol):
    """Who is told remarks and fractions of frames."""

    def say(self, text: str, kind: str = "note", /) -> None:
        """Take a remark."""

    def within(self, frames: float) -> None:
        """Take note that the work went on by a fraction of a frame."""


class FrameProgress:
    """Frames that are done, rate and remaining time, and remarks.

    Within a frame too: the bar moves by fractions, plain lines come at least every `SLOW` seconds. Where a
    frame takes longer, the hint is told, once.

    Args:
        total: Number of frames.
        hint: What could make slow frames faster, empty for nothing.
        title: What the bar says before the first frame.
        unit: What is counted, where that is not frames.
    """

    def __init__(self, total: int, hint: str = "", title: str = "denoising", unit: str = "frame") -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.total, self.done, self.hint, self.unit = total, 0, hint, unit
        self.start = self._told = self._begun = time.monotonic()
        self._at, self._doing = 0.0, ""
        self._said: set[str] = set()
        self._over = threading.Event()
        self._watch = threading.Thread(target=self._look, daemon=True)
        console = Console(stderr=True)
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[count]}"),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
            )
            self.bar = Progress(*columns, console=console)
            self.task = self.bar.add_task(title, total=total, count=self._count())

    def __enter__(self) -> FrameProgress:
        """Show the bar."""
        if self.bar is not None:
            self.bar.start()
        self._watch.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Leave the bar as it is."""
        self._over.set()
        self._watch.join()
        if self.bar is not None:
            self.bar.stop()

    @property
    def rate(self) -> str:
        """Frames per second since the start, or seconds per frame where that is more than one."""
        seconds = max(time.monotonic() - self.start, 1e-9)
        if 0 < self.done < seconds:
            return f"{seconds / self.done:.1f} s per {self.unit}"
        return f"{self.done / seconds:.2f} {self.unit}s/s"

    def say(self, text: str, kind: str = "note", /) -> None:
        """Show a remark, once."""
        if text in self._said:
            return
        self._said.add(text)
        if self.bar is not None:
            self.bar.console.print(f"{kind}: {text}", highlight=False, markup=False, soft_wrap=True)
        else:
            print(f"{kind}: {text}", file=sys.stderr, flush=True)

    def doing(self, text: str) -> None:
        """Show what is being done within a frame."""
        self._doing = text
        if self.bar is not None:
            self.bar.update(self.task, description=text)

    def within(self, frames: float) -> None:
        """Go on by a fraction of a frame."""
        touch()
        self._at += frames
        if self.bar is not None:
            self.bar.update(self.task, completed=min(self._at, self.total))

    def advance(self, name: str) -> None:
        """Count a frame."""
        touch()
        self.done += 1
        self._at = max(self._at, float(self.done))
        self._begun = self._told = time.monotonic()
        if self.bar is not None:
            self.bar.update(self.task, completed=self._at, description=name, count=self._count())
        else:
            print(f"{self.done}/{self.total} {name} ({self.rate})", file=sys.stderr, flush=True)

    def _count(self) -> str:
        return f"{self.done}/{self.total}" + (f" {self.rate}" if self.done else "")

    def _look(self) -> None:
        """Tell, from a thread of its own, that work goes on."""
        while not self._over.wait(0.2):
            now = time.monotonic()
            if self.hint and now - self._begun > SLOW:
                self.say(self.hint)
            if self.bar is None and now - self._told >= SLOW:
                self._told = now
                print(self._line(now - self.start), file=sys.stderr, flush=True)

    def _line(self, seconds: float) -> str:
        number = min(int(self._at) + 1, self.total)
        text = f"{self.unit} {number}/{self.total}: {duration(seconds)} so far"
        if self._doing:
            text += f" ({self._doing})"
        if self._at <= 0:
            return text
        left = seconds * (self.total - self._at) / self._at
        return f"{text}, {self._at / self.total:.0%} done, about {duration(max(left, 0))} left"
