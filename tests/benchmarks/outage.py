"""Figure 3: what a tracking server costs a training step: healthy, away, slow (2 s per request), and none.

One small WSKP training with Lightning, on as many threads as there are cores, records every step, ten times
as often as by default. It is cut into blocks of a few seconds: in each the training records to a server of
one kind, and only the sending to that server goes on. The kinds follow each other in turn, in another order
every round, and are compared within a round, so that all meet the same load of the machine. System metrics
are on. Servers are MLflow's own application in processes of the lowest priority, since they would run on
another machine; the slow one answers everything two seconds late, and where none is there connections are
refused.

Times of steps vary by more than what is looked for. What does not is counted too: the time that the training
thread spends in calls of the tracking, the longest of these calls, and the processor time of the sender.

    python -m tests.benchmarks.outage
"""

from __future__ import annotations

import contextlib
import random
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, Trainer
from torch.utils.data import DataLoader

from models import WSKP
from tests.benchmarks.timing import Row, print_table, row
from tests.synthetic import Patches
from tests.tracking_server import free_port, running
from trainer.modules import Regression
from trainer.spool.sent import left
from trainer.tracking import MLflowTracking

KINDS = ("none", "healthy", "away", "slow")
ROUNDS, BLOCK_S = 12, 4.0
SETTLE = 2
"""Steps at the beginning of a block that are not counted: what the block before began may end in them."""
DELAY_S = 2.0
TARGET = 1.02


@dataclass
class Block:
    """What was measured in a block.

    Attributes:
        steps: Seconds of each step, from the end of the one before.
        calls: Seconds of each call of the tracking on the training's thread.
        calls_cpu: Processor seconds of these calls.
        sender_cpu: Processor seconds of the sending thread.
    """

    steps: list[float] = field(default_factory=list)
    calls: list[float] = field(default_factory=list)
    calls_cpu: float = 0.0
    sender_cpu: float = 0.0


class Kind:
    """A run that is tracked by one kind of server, in its own blocks only.

    Args:
        uri: Server; None for no tracking at all.
        root: Folder of runs.
    """

    def __init__(self, uri: str | None, root: Path) -> None:
        self.blocks: list[Block] = []
        self.logger: MLflowTracking | None = None
        if uri is None:
            return
        self.logger = MLflowTracking("outage", uri, root=str(root))
        self.logger.set_tags({"benchmark": "outage"})  # which opens the run
        self._sender, sampler = self.logger._sender, self.logger._sampler
        assert self._sender is not None
        assert self._sender.ident is not None
        assert sampler is not None
        self._sampler, self._monitors = sampler, sampler._monitors
        self._clock = time.pthread_getcpuclockid(self._sender.ident)
        self._turn = threading.Event()
        self._sender._delivery.step = self._waiting(self._sender._delivery.step)
        self.logger.log_metrics = self._timed(self.logger.log_metrics)
        self.end()

    def begin(self, trainer: Trainer) -> None:
        """Begin a block."""
        self.blocks.append(Block())
        trainer.loggers = [self.logger] if self.logger else []
        if self.logger:
            self._began = time.clock_gettime(self._clock)
            self._sampler._monitors = self._monitors
            self._turn.set()

    def end(self) -> None:
        """End a block: nothing is sent or sampled until the next."""
        if self.logger:
            self._turn.clear()
            self._sampler._monitors = []
            if self.blocks:
                self.blocks[-1].sender_cpu = time.clock_gettime(self._clock) - self._began

    def finish(self) -> tuple[float, int]:
        """End the run; returns the seconds that this took, and the events that are not sent."""
        if self.logger is None:
            return 0.0, 0
        self._turn.set()
        begin = time.perf_counter()
        self.logger.finalize("success")
        return time.perf_counter() - begin, left(self.logger.folder)

    def _waiting(self, step: Callable[[], int]) -> Callable[[], int]:
        def waiting() -> int:
            self._turn.wait()
            return step()

        return waiting

    def _timed(self, call: Callable[..., None]) -> Callable[..., None]:
        def timed(*arguments: Any, **options: Any) -> None:
            wall, cpu = time.perf_counter(), time.thread_time()
            call(*arguments, **options)
            self.blocks[-1].calls.append(time.perf_counter() - wall)
            self.blocks[-1].calls_cpu += time.thread_time() - cpu

        return timed


class Turns(Callback):
    """Gives every kind its blocks, and times their steps."""

    def __init__(self, kinds: dict[str, Kind]) -> None:
        names = [[*KINDS[turn % 4 :], *KINDS[: turn % 4]] for turn in range(ROUNDS)]
        self._order = [kinds[name] for round_ in names for name in round_]
        self._turn = -1
        self._count = 0
        self._until = self._last = 0.0  # of time.perf_counter

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self._until = time.perf_counter() + BLOCK_S  # which warms up

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if time.perf_counter() < self._until or self._turn + 1 == len(self._order):
            return
        if self._turn >= 0:
            self._order[self._turn].end()
        self._turn += 1
        self._order[self._turn].begin(trainer)
        self._count = 0
        self._until = time.perf_counter() + BLOCK_S

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        if self._turn >= 0 and self._count >= SETTLE:
            self._order[self._turn].blocks[-1].steps.append(now - self._last)
        self._last, self._count = now, self._count + 1
        if now >= self._until and self._turn + 1 == len(self._order):
            self._order[self._turn].end()
            trainer.loggers = []
            trainer.should_stop = True


def run() -> list[Row]:
    """Measure and return the rows of figure 3."""
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        root = Path(folder)
        kinds = {
            "none": Kind(None, root),
            "healthy": Kind(stack.enter_context(running(root / "healthy", priority=19)), root / "runs"),
            "away": Kind(f"http://127.0.0.1:{free_port()}", root / "runs"),
            "slow": Kind(stack.enter_context(running(root / "slow", DELAY_S, priority=19)), root / "runs"),
        }
        batches = list(DataLoader(Patches(4, 0), 4)) * 1_000_000
        trainer = Trainer(
            max_epochs=1, logger=False, callbacks=[Turns(kinds)], accelerator="cpu", log_every_n_steps=1,
            enable_checkpointing=False, enable_model_summary=False, enable_progress_bar=False,
        )  # fmt: skip
        trainer.fit(Regression(WSKP(width=14)), DataLoader(batches, batch_size=None))
        ends = {name: kinds[name].finish() for name in KINDS[1:]}
    return [*times({name: kind.blocks for name, kind in kinds.items()}), *finishes(ends)]


def times(blocks: dict[str, list[Block]]) -> list[Row]:
    """Return what the steps and the calls of the tracking took."""
    medians = {kind: [statistics.median(block.steps) for block in blocks[kind]] for kind in KINDS}
    means = {kind: [statistics.fmean(block.steps) for block in blocks[kind]] for kind in KINDS}
    result = [row(f"step, server {kind}", statistics.median(medians[kind]) * 1e3, "ms") for kind in KINDS]
    pairs = (("away", "healthy"), ("slow", "healthy"), *((kind, "none") for kind in KINDS[1:]))
    for kind, base in pairs:
        ratio = statistics.median(ratios(medians[kind], medians[base]))
        result.append(judged(f"median step, server {kind} / {base}", ratio, base == "healthy"))
        found = ratios(means[kind], means[base])
        name = f"mean step, server {kind} / {base}"
        result.append(judged(name, statistics.fmean(found), base == "healthy"))
        for end, value in zip(("from", "to"), interval(found), strict=True):
            result.append(row(f"{name}, 95 % {end}", value, "x"))
    for kind in KINDS[1:]:
        calls = [call for block in blocks[kind] for call in block.calls]
        step = statistics.median(medians["none"])
        cpu = sum(block.calls_cpu + block.sender_cpu for block in blocks[kind]) / len(calls)
        result += [
            judged(
                f"step with the calls of tracking, server {kind} / none", 1 + statistics.fmean(calls) / step
            ),
            judged(f"… and with the processor time of its sender, server {kind}", 1 + cpu / step),
            row(f"longest call of tracking, server {kind}", max(calls) * 1e3, "ms"),
        ]
    return result


def judged(name: str, ratio: float, target: bool = True) -> Row:
    """Return the row of a ratio of steps."""
    return row(name, ratio, "x", *((f"<= {TARGET}", ratio <= TARGET) if target else ("", None)))


def finishes(ends: dict[str, tuple[float, int]]) -> list[Row]:
    """Return how the runs ended: seconds and events that were not sent."""
    result = []
    for kind, (seconds, unsent) in ends.items():
        result.append(row(f"end of the run, server {kind}", seconds, "s"))
        result.append(row(f"events left for `trainer sync`, server {kind}", float(unsent), ""))
    return result


def ratios(one: list[float], other: list[float]) -> list[float]:
    """Return the ratios within the rounds."""
    return [a / b for a, b in zip(one, other, strict=True)]


def interval(values: list[float], draws: int = 5000) -> tuple[float, float]:
    """Return the interval that holds the mean with 95 %, from draws of the values with repetition."""
    generator = random.Random(0)
    means = sorted(statistics.fmean(generator.choices(values, k=len(values))) for _ in range(draws))
    return means[draws // 40], means[-draws // 40]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
