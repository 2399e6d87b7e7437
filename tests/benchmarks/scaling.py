"""Figure 1 of the service: two processes against one, and what that says of many GPUs.

    python -m tests.benchmarks.scaling

WSKP trains with 8 patches per rank and step, one thread per process: one process; two that train together and
send each other gradients (DDP, gloo); two that train at the same time and know nothing of each other, which
shows what sharing the machine costs. The kinds take turns. Scaling efficiency is the step time of one process
divided by that of two together; the share of communication is what two together take longer than two apart.

The projection is a model of the cost of one step, with the assumptions that `Cluster` lists: computing as
many multiply-adds as were counted, a ring of all GPUs that sums the gradients after the backward pass without
overlap, and a store that delivers the bytes of the patches.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from tests.benchmarks.timing import Row, print_table, row

ROUNDS, STEPS, WARM, BATCH = 5, 16, 4, 8
GPUS = (8, 64, 512)


@dataclass(frozen=True)
class Cluster:
    """What the projection assumes of GPUs, network and store; all are rates that programs reach, not peaks.

    Attributes:
        flops: Operations per second of one GPU on small convolutions in float32 with TF32 or bfloat16.
        inside: Bytes per second between two GPUs of a machine.
        between: Bytes per second between two machines, for each machine.
        latency_s: Of one message between machines.
        store: Bytes per second of the store to all machines together.
        machine: GPUs of one machine.
    """

    flops: float = 20e12
    inside: float = 150e9
    between: float = 20e9
    latency_s: float = 15e-6
    store: float = 5e9
    machine: int = 8


class StepTimes(Callback):
    """Writes the time of every step, and the waiting for data in it, when training ends.

    Args:
        path: JSON file; `RANK` of the process is appended to its name.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(f"{path}.{os.environ.get('RANK', '0')}")
        self.steps: list[float] = []
        self._began = time.perf_counter()
        self._waited = 0.0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Note the time since the step before."""
        now = time.perf_counter()
        if batch_idx >= WARM:
            self.steps.append(now - self._began)
        elif batch_idx == WARM - 1:
            self._waited = trainer.train_dataloader.waited_s  # type: ignore[union-attr]
        self._began = now

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file."""
        waited = trainer.train_dataloader.waited_s - self._waited  # type: ignore[union-attr]
        self.path.write_text(json.dumps({"steps": self.steps, "waiting": waited / sum(self.steps)}))


def start(folder: Path, name: str, torchrun: bool, model: str = "") -> subprocess.Popen[bytes]:
    """Start a training of a few steps whose times go to `folder/name.RANK`."""
    callback = f"{{class_path: tests.benchmarks.scaling.StepTimes, init_args: {{path: {folder / name}}}}}"
    command = [sys.executable, "-m"]
    if torchrun:
        command += ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m"]
    command += [
        "trainer", "fit", "--config", model or "wskp_bmfr.yaml", "--trainer.max_epochs", "1",
        "--trainer.accelerator", "cpu", "--trainer.limit_train_batches", str(WARM + STEPS),
        "--trainer.limit_val_batches", "0", "--trainer.logger", "false",
        "--trainer.callbacks", f"[{callback}]",
        "--trainer.enable_checkpointing", "false", "--data.init_args.batch_size", str(BATCH),
    ]  # fmt: skip
    if torchrun:
        command += ["--trainer.devices", "2", "--trainer.strategy", "ddp"]
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": root}
    with (folder / f"{name}.log").open("wb") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)


def finish(folder: Path, names: list[str], processes: list[subprocess.Popen[bytes]]) -> list[dict[str, Any]]:
    """Return what trainings measured, when all are done.

    Raises:
        RuntimeError: One failed.
    """
    for name, process in zip(names, processes, strict=True):
        if process.wait(600):
            raise RuntimeError(f"{name}: {(folder / f'{name}.log').read_text()[-2000:]}")
    found = [json.loads(path.read_text()) for name in names for path in sorted(folder.glob(f"{name}.[0-9]"))]
    for name in names:
        for path in folder.glob(f"{name}.[0-9]"):
            path.unlink()
    return found


def measure(folder: Path) -> dict[str, dict[str, list[float]]]:
    """Return kind → step times of each round (medians), and shares of waiting for data."""
    kinds: dict[str, list[tuple[str, bool]]] = {
        "one": [("one", False)],
        "together": [("together", True)],
        "apart": [("apart-0", False), ("apart-1", False)],
    }
    found: dict[str, dict[str, list[float]]] = {kind: {"step": [], "waiting": []} for kind in kinds}
    for turn in range(ROUNDS + 1):
        for kind, members in kinds.items():
            names = [name for name, _ in members]
            results = finish(folder, names, [start(folder, name, torchrun) for name, torchrun in members])
            if turn:  # the first prepares the shards and fills the page cache
                found[kind]["step"].append(statistics.median(t for r in results for t in r["steps"]))
                found[kind]["waiting"].append(statistics.mean(r["waiting"] for r in results))
    return found


def sizes() -> tuple[int, float, float]:
    """Return gradient bytes, operations of one patch forward and backward, bytes of one stored patch."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    from data import Shards
    from models import WSKP

    net = WSKP(layers=6)
    shapes = {"irradiance": 3, "albedo": 3, "normal": 3, "depth": 1}
    patch = {name: torch.rand(1, channels, 128, 128) for name, channels in shapes.items()}
    with FlopCounterMode(display=False) as counter:
        net(patch).color.sum().backward()
    module = Shards()
    module.prepare_data()
    train = module.index.of("train")
    stored = sum(shard.bytes for shard in train) / sum(len(shard.samples) for shard in train)
    return sum(p.numel() * 4 for p in net.parameters()), float(counter.get_total_flops()), stored


def projection(
    gradient: int, operations: float, stored: float, cluster: Cluster, gpus: int
) -> dict[str, float]:
    """Return seconds of a step of `BATCH` patches per GPU for computing, summing gradients, reading patches.

    A ring passes 2 (n - 1) / n of the gradients through its slowest link in 2 (n - 1) messages.
    """
    computing = BATCH * operations / cluster.flops
    link = cluster.inside if gpus <= cluster.machine else cluster.between
    summing = 2 * (gpus - 1) / gpus * gradient / link
    summing += 2 * math.ceil(gpus / cluster.machine - 1) * cluster.latency_s
    reading = gpus * BATCH * stored / cluster.store
    return {"computing": computing, "summing": summing, "reading": reading}


def projected(cluster: Cluster) -> list[Row]:
    """Return rows for each number of GPUs, and the number at which the store has no more to give."""
    gradient, operations, stored = sizes()
    rows = [
        row("gradients of a step", gradient / 1e6, "MB"),
        row("operations of a patch, forward and backward", operations / 1e9, "G"),
        row("one stored patch", stored / 1e6, "MB"),
    ]
    for gpus in GPUS:
        parts = projection(gradient, operations, stored, cluster, gpus)
        step = max(parts["computing"] + parts["summing"], parts["reading"])
        busy = parts["computing"] / step
        first = max(parts, key=lambda name: parts[name])
        rows += [row(f"{gpus} GPUs: {name}", 1e3 * seconds, "ms") for name, seconds in parts.items()] + [
            row(f"{gpus} GPUs: efficiency; most time goes to {first}", busy, "")
        ]
    alone = projection(gradient, operations, stored, cluster, 1)["computing"]
    rows.append(row("GPUs that the store can feed", cluster.store * alone / (BATCH * stored), ""))
    return rows


def run() -> list[Row]:
    """Measure, then project."""
    with tempfile.TemporaryDirectory() as name:
        found = measure(Path(name))
    one, together, apart = (statistics.median(found[k]["step"]) for k in ("one", "together", "apart"))
    ratios = [a / b for a, b in zip(found["one"]["step"], found["together"]["step"], strict=True)]
    efficiency = statistics.median(ratios)
    return [
        row("step of one process", one, "s"),
        row("step of two processes together", together, "s"),
        row("step of two processes apart", apart, "s"),
        row("scaling efficiency", efficiency, "", ">= 0.90", efficiency >= 0.9),
        row("the same, of two processes apart", one / apart, ""),
        row("share of communication", max(0.0, 1 - apart / together), ""),
        row("share of waiting for data, one process", statistics.median(found["one"]["waiting"]), ""),
        row("share of waiting for data, two together", statistics.median(found["together"]["waiting"]), ""),
        *projected(Cluster()),
    ]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    print_table(run())
