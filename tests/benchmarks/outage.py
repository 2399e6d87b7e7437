"""Figure 3: what a tracking server costs a training step: healthy, away, slow (2 s per request), and none.

A small WSKP training with Lightning records every step (ten times as often as by default). It runs in blocks
of each kind in turn, in a new order every round, and a round's medians are compared with each other, so that
all kinds meet the same load of the machine. Servers are MLflow's own application in processes of their own;
the slow one answers everything two seconds late, and where none is there connections are refused. System
metrics are on.

    python -m tests.benchmarks.outage
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
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
from trainer.spool.delivery import left
from trainer.tracking import MLflowTracking

KINDS = ("none", "healthy", "away", "slow")
ROUNDS, STEPS, WARM = 5, 90, 10
DELAY_S = 2.0


class Clock(Callback):
    """Times every step from the end of the one before, which includes what is recorded."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._last: float | None = None

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        if self._last is not None:
            self.times.append(now - self._last)
        self._last = now


def train(uri: str | None, root: Path) -> tuple[list[float], float, int]:
    """Return the times of the steps, the seconds that the end took, and the events left unsent."""
    logger = MLflowTracking("outage", uri, root=str(root)) if uri else False
    clock = Clock()
    batches = list(DataLoader(Patches(4, 0), 4)) * (STEPS + WARM)
    trainer = Trainer(
        max_epochs=1, logger=logger, callbacks=[clock], accelerator="cpu", enable_checkpointing=False,
        enable_model_summary=False, enable_progress_bar=False, log_every_n_steps=1,
    )  # fmt: skip
    trainer.fit(Regression(WSKP(width=14)), DataLoader(batches, batch_size=None))
    ended = time.perf_counter() - (clock._last or 0.0)
    return clock.times[WARM:], ended, left(logger.folder) if logger else 0


def run() -> list[Row]:
    """Measure and return the rows of figure 3."""
    torch.manual_seed(0)
    medians: dict[str, list[float]] = {kind: [] for kind in KINDS}
    means: dict[str, list[float]] = {kind: [] for kind in KINDS}
    ends: dict[str, list[float]] = {kind: [] for kind in KINDS}
    rest = dict.fromkeys(KINDS, 0)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        root = Path(folder)
        uris = {
            "none": None,
            "healthy": stack.enter_context(running(root / "healthy")),
            "away": f"http://127.0.0.1:{free_port()}",
            "slow": stack.enter_context(running(root / "slow", DELAY_S)),
        }
        train(uris["healthy"], root / "runs")
        for turn in range(ROUNDS):
            for kind in (*KINDS[turn % 4 :], *KINDS[: turn % 4]):
                times, ended, unsent = train(uris[kind], root / "runs")
                medians[kind].append(statistics.median(times))
                means[kind].append(statistics.fmean(times))
                ends[kind].append(ended)
                rest[kind] += unsent
    return rows(medians, means, ends, rest)


def rows(
    medians: dict[str, list[float]],
    means: dict[str, list[float]],
    ends: dict[str, list[float]],
    rest: dict[str, int],
) -> list[Row]:
    """Return the table of what was measured in every round."""
    result = [row(f"step, server {kind}", statistics.median(medians[kind]) * 1e3, "ms") for kind in KINDS]
    for kind, base in (("away", "healthy"), ("slow", "healthy"), ("healthy", "none")):
        ratio = paired(medians[kind], medians[base])
        target = ("<= 1.02", ratio <= 1.02) if base == "healthy" else ("", None)
        result.append(row(f"median step, server {kind} / {base}", ratio, "x", *target))
        result.append(row(f"mean step, server {kind} / {base}", paired(means[kind], means[base]), "x"))
    for kind in KINDS[1:]:
        result.append(row(f"end of the run, server {kind}", statistics.median(ends[kind]), "s"))
        result.append(row(f"events left for `trainer sync`, server {kind}", float(rest[kind]), ""))
    return result


def paired(one: list[float], other: list[float]) -> float:
    """Return the median of the ratios within the rounds."""
    return statistics.median(a / b for a, b in zip(one, other, strict=True))


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
