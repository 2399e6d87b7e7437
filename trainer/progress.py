"""Progress of work that is counted in samples: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from data.shards.progress import Rate, duration

INTERVAL = 15.0
"""Seconds between plain lines."""


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
            bar.update(task, completed=done, total=total, text=rate.text(done, total), description=label)

        yield update


def _lines(title: str, rate: SampleRate) -> Callable[[int, int, str], None]:
    last = [-INTERVAL]

    def update(done: int, total: int, label: str) -> None:
        text = rate.text(done, total)
        now = time.monotonic()
        if now - last[0] >= INTERVAL or done == total:
            last[0] = now
            print(f"{title}: {text} ({label})", file=sys.stderr, flush=True)

    return update
