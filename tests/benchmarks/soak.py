"""Figure 2 of the service: a training of which 30 processes are killed ends as if nothing had happened.

    make soak
    python -m tests.benchmarks.soak --kills 30 --seed 1

Two ranks train WSKP under torchrun on shards in an S3 store, tracked by an MLflow server on PostgreSQL, all
with the commands of the compose file. At random moments one of these ends with SIGKILL: the first rank, the
other rank, a process that reads data, the tracking server, the S3 server; servers come back after up to ten
seconds. Compared are the weights with those of one process that trains undisturbed on the same batches from a
local disk, to the bit, and the history of every metric with that of two undisturbed ranks.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from tests.benchmarks.timing import Row, print_table, row
from tests.end_to_end.processes import kill, ranks, readers
from tests.stack.processes import Server, ServerError
from tests.stack.servers import Stack
from trainer.runs import RunRecord

KILLS, APART, ENOUGH = 30, 8, 24
"""Processes that are killed, steps between two that stop the training, and steps of the training for each."""
AWAY_S = 10.0
PATIENCE_S = 600
VICTIMS = ("first rank", "other rank", "reader", "tracking server", "S3 server")
OVERLAY = """
trainer:
  log_every_n_steps: 1
  callbacks:
    - class_path: trainer.callbacks.TrainingProgress
    - class_path: trainer.callbacks.LastCheckpoint
      init_args: {every_n_train_steps: 3}
    - class_path: trainer.callbacks.FiniteGuard
"""
UNEQUAL = ("system/", "throughput/")
"""Metrics that tell of the machine and differ from run to run."""


class Training:
    """One training in a folder of its own.

    Args:
        folder: Where it is started.
        steps: Optimiser steps.
        environment: Variables beside those of this process.
    """

    def __init__(self, folder: Path, steps: int, environment: dict[str, str]) -> None:
        self.folder = folder
        folder.mkdir()
        (folder / "overlay.yaml").write_text(OVERLAY)
        inherited = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "AWS_"))}
        root = str(Path(__file__).resolve().parents[2])
        self.environment = inherited | {"OMP_NUM_THREADS": "1", "PYTHONPATH": root} | environment
        self.options = [
            "fit", "--config", "wskp_bmfr.yaml", "--config", "overlay.yaml", "--trainer.max_epochs", "-1",
            "--trainer.max_steps", str(steps), "--trainer.accelerator", "cpu",
            "--data.init_args.batch_size", "1",
        ]  # fmt: skip
        self.log = folder / "log"

    def prepare(self, root: str) -> None:
        """Cut the shipped frames into shards, in a folder or an S3 store."""
        self.wait(self.start([sys.executable, "-m", "trainer", "prepare", "sample:bmfr", "--output", root]))

    def one_process(self, shards: Path) -> None:
        """Train on the batches of both ranks in turn, two for each step."""
        data = ["--data", "tests.end_to_end.ddp_modules.Interleaved", "--data.init_args.root", str(shards)]
        module = ["--model", "tests.end_to_end.ddp_modules.HalvedGradients"]
        command = [sys.executable, "-m", "trainer", *self.options, *data, *module]
        self.wait(self.start([*command, "--trainer.accumulate_grad_batches", "2"]))

    def two_ranks(self, shards: str) -> subprocess.Popen[bytes]:
        """Start two ranks under torchrun."""
        torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
        command = [*torchrun, "--max-restarts", "1000", "-m", "trainer", *self.options]
        ddp = ["--trainer.devices", "2", "--trainer.strategy", "ddp", "--data.init_args.root", shards]
        return self.start([*command, *ddp])

    def start(self, command: list[str]) -> subprocess.Popen[bytes]:
        """Start a command whose output goes to the log."""
        with self.log.open("ab") as log:
            return subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log)

    def wait(self, process: subprocess.Popen[bytes]) -> None:
        """Wait for the end.

        Raises:
            RuntimeError: It failed.
        """
        if process.wait(7200) != 0:
            raise RuntimeError(f"the training failed\n{self.log.read_text()[-3000:]}")

    @property
    def runs(self) -> list[Path]:
        """Folders of its runs."""
        return [path.parent for path in self.folder.glob("runs/*/*/run.json")]

    def step(self) -> int:
        """Return the step of the newest checkpoint, 0 without one."""
        for path in self.folder.glob("runs/*/*/checkpoints/last.ckpt"):
            return int(torch.load(path, weights_only=True)["global_step"])
        return 0

    def weights(self) -> dict[str, torch.Tensor]:
        """Return the weights of the last checkpoint."""
        (path,) = self.folder.glob("runs/*/*/checkpoints/last.ckpt")
        state: dict[str, torch.Tensor] = torch.load(path, weights_only=True)["state_dict"]
        return state

    def history(self) -> dict[str, list[tuple[int, float]]]:
        """Return steps and values of every metric as the tracking server has them."""
        from mlflow.tracking import MlflowClient

        (folder,) = self.runs
        record = RunRecord.load(folder)
        saved = {k: os.environ.get(k) for k in self.environment if k.startswith("MLFLOW_")}
        os.environ.update({k: self.environment[k] for k in saved})
        try:
            client = MlflowClient(tracking_uri=record.tracking_uri)
            run = client.get_run(record.run_id or "")
            names = [name for name in run.data.metrics if not name.startswith(UNEQUAL)]
            found = {name: client.get_metric_history(run.info.run_id, name) for name in names}
        finally:
            for key, value in saved.items():
                os.environ.pop(key) if value is None else os.environ.__setitem__(key, value)
        return {name: sorted((m.step, m.value) for m in history) for name, history in found.items()}


def disturb(
    training: Training, process: subprocess.Popen[bytes], stack: Stack, kills: int, seed: int
) -> Counter[str]:
    """Kill processes at random moments until enough are killed or the training has ended; returns how many.

    After a process of the training was killed, the next one is when the training has gone on.
    """
    chance, killed, returning = random.Random(seed), Counter[str](), Returning()
    wanted = 1
    while sum(killed.values()) < kills and process.poll() is None:
        await_step(training, process, wanted)
        time.sleep(chance.uniform(0, 3))
        victim = chance.choice(VICTIMS)
        if victim.endswith("server"):
            server = stack.tracking if victim == "tracking server" else stack.storage
            if not server.running or returning.awaits(server):
                continue
            server.kill()
            returning.later(server, chance.uniform(0, AWAY_S))
        elif not strike(process.pid, victim, chance):
            continue
        else:
            wanted = training.step() + APART
        killed[victim] += 1
        print(f"killed {sum(killed.values())} of {kills}: {victim}, at step {training.step()}", flush=True)
    returning.wait()
    return killed


class Returning:
    """Starts servers again after a time, on one thread that lives as long as this process.

    A server ends with the thread that started it.
    """

    def __init__(self) -> None:
        self._due: list[tuple[float, Server]] = []
        self._changed = threading.Condition()
        self._trouble: BaseException | None = None
        threading.Thread(target=self._run, daemon=True).start()

    def later(self, server: Server, seconds: float) -> None:
        """Start a server in some seconds."""
        with self._changed:
            self._due.append((time.monotonic() + seconds, server))
            self._changed.notify_all()

    def awaits(self, server: Server) -> bool:
        """Return whether a server is not back yet."""
        with self._changed:
            return any(other is server for _, other in self._due)

    def wait(self) -> None:
        """Wait until all are back.

        Raises:
            ServerError: One did not start.
        """
        with self._changed:
            while self._due and self._trouble is None:
                self._changed.wait()
        if self._trouble is not None:
            raise self._trouble

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._due:
                    self._changed.wait()
                self._due.sort(key=lambda entry: entry[0])
                when, server = self._due[0]
            time.sleep(max(0.0, when - time.monotonic()))
            try:
                server.start()
            except ServerError as error:
                self._trouble = error
            with self._changed:
                self._due.pop(0)
                self._changed.notify_all()


def strike(agent: int, victim: str, chance: random.Random) -> bool:
    """Kill a process of the training; returns whether it was there."""
    found = readers(agent) if victim == "reader" else ranks(agent)
    if not found:
        return False
    return kill(chance.choice(found) if victim == "reader" else found[0 if victim == "first rank" else -1])


def await_step(training: Training, process: subprocess.Popen[bytes], step: int) -> None:
    """Wait until a checkpoint of a step is there, or the training has ended.

    Raises:
        RuntimeError: That takes longer than ten minutes.
    """
    deadline = time.monotonic() + PATIENCE_S
    while training.step() < step and process.poll() is None:
        if time.monotonic() > deadline:
            told = training.log.read_text()[-3000:]
            raise RuntimeError(f"the training stands still before step {step}\n{told}")
        time.sleep(0.2)


def compare(disturbed: Training, alone: Training, whole: Training) -> list[Row]:
    """Return how far the disturbed training is from the undisturbed ones."""
    found, expected = disturbed.weights(), alone.weights()
    apart = max(float((found[name] - value).abs().max()) for name, value in expected.items())
    history, complete = disturbed.history(), whole.history()
    steps = {name: [step for step, _ in values] for name, values in history.items()}
    twice = sum(len(s) - len(set(s)) for s in steps.values())
    gaps = sum(len({s for s, _ in values} - set(steps.get(name, []))) for name, values in complete.items())
    other = sum(history.get(name) != values for name, values in complete.items())
    return [
        row("weights differ from one undisturbed process by", apart, "", "= 0", apart == 0),
        row("MLflow runs", len(disturbed.runs), "", "= 1", len(disturbed.runs) == 1),
        row("metrics", len(complete), "", "> 0", len(complete) > 0),
        row("values of metrics", sum(map(len, complete.values())), ""),
        row("values that are missing", gaps, "", "= 0", gaps == 0),
        row("values that are there twice", twice, "", "= 0", twice == 0),
        row("metrics whose history differs", other, "", "= 0", other == 0),
    ]


def run(kills: int = KILLS, seed: int = 1) -> list[Row]:
    """Train undisturbed and disturbed, and compare."""
    steps = kills * ENOUGH
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        local = {"PENUMBRA_CACHE": str(folder / "cache")}
        alone, whole = (Training(folder / kind, steps, local) for kind in ("alone", "whole"))
        shards = folder / "shards"
        alone.prepare(str(shards))
        alone.one_process(shards)
        whole.wait(whole.two_ranks(str(shards)))
        with Stack(folder / "stack") as stack:
            disturbed = Training(folder / "disturbed", steps, local | stack.environment)
            began = time.monotonic()
            killed = soak(disturbed, stack, kills, seed)
            took = time.monotonic() - began
            rows = compare(disturbed, alone, whole)
    total = sum(killed.values())
    return [
        *(row(f"killed: {victim}", killed[victim], "") for victim in VICTIMS),
        row("killed in all", total, "", f"= {kills}", total == kills),
        row("time of the disturbed training", took, "s"),
        *rows,
    ]


def soak(training: Training, stack: Stack, kills: int, seed: int) -> Counter[str]:
    """Train disturbed on shards in the S3 store; returns what was killed."""
    remote = f"{stack.bucket_url}/shards"
    training.prepare(remote)
    process = training.two_ranks(remote)
    try:
        killed = disturb(training, process, stack, kills, seed)
        training.wait(process)
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(60)
    return killed


def main() -> int:
    """Run from the command line; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--seed", type=int, default=1)
    options: Any = parser.parse_args()
    rows = run(options.kills, options.seed)
    print_table(rows)
    return int(any(entry["meets"] is False for entry in rows))


if __name__ == "__main__":
    sys.exit(main())
