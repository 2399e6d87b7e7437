"""One trial of a search: a training with some values changed, which reports every validation."""

from __future__ import annotations

import copy
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from models.denoiser import Denoiser
from trainer.cluster.checked import Training
from trainer.cluster.engine import enter
from trainer.cluster.fitting import Group, resources
from trainer.cluster.space import options
from trainer.cluster.worker import ExtendedCLI
from trainer.runs import TRAINING_VARIABLE
from trainer.tracking import MLflowTracking

COST = "cost/ms_per_megapixel"
SIDE = 256
REPEATS = 5
LEFT_OUT = ("ExportBest", "ValidationPictures")
"""Callbacks that trials do without: a search would register a model and draw pictures for each of them."""


@dataclass(frozen=True)
class Sweep:
    """What the trials of a search have in common.

    Attributes:
        name: Name of the search.
        training: What is varied.
        group: The processes of each trial.
        folder: Where they work.
        environment: Variables that they get.
        metric: Logged number that is searched for.
        mode: `max` or `min`.
        parent: MLflow run of the search, empty where it has none.
    """

    name: str
    training: Training
    group: Group
    folder: str
    environment: dict[str, str]
    metric: str
    mode: str
    parent: str = ""


def launch_of(search: str, trial: str) -> str:
    """Return the launch of a trial, by which one that is started again finds its run."""
    return f"tune {search} {trial}"


def run_trial(values: dict[str, Any], sweep: Sweep) -> None:
    """Train with values, and report to Ray Tune; called in a process of the trial."""
    from ray import tune

    identity = tune.get_context().get_trial_id()
    if sweep.group.workers == 1:
        train_trial(values, sweep, identity, tune.report, ExtendedCLI)
        return
    import ray.train
    from ray.train.torch import TorchTrainer
    from ray.tune.integration.ray_train import TuneReportCallback

    with tempfile.TemporaryDirectory(prefix="penumbra-ray-") as scratch:
        TorchTrainer(
            _run_rank,
            train_loop_config={"values": values, "sweep": sweep, "identity": identity},
            scaling_config=ray.train.ScalingConfig(
                num_workers=sweep.group.workers,
                use_gpu=sweep.group.gpus > 0,
                resources_per_worker=resources(sweep.group),
            ),
            run_config=ray.train.RunConfig(
                name=identity,
                storage_path=scratch,
                callbacks=[TuneReportCallback()],  # type: ignore[list-item]
            ),
        ).fit()


def _run_rank(config: dict[str, Any]) -> None:
    import ray.train

    from trainer.cluster.worker import RayTrainingCLI

    RayTrainingCLI.gpus = config["sweep"].group.gpus
    train_trial(config["values"], config["sweep"], config["identity"], ray.train.report, RayTrainingCLI)


def train_trial(
    values: dict[str, Any],
    sweep: Sweep,
    identity: str,
    report: Callable[[dict[str, Any]], None],
    cli: type[ExtendedCLI],
) -> None:
    """Train with values in this process.

    Args:
        values: Key of the configuration → value.
        sweep: What all trials have in common.
        identity: Name of the trial; a trial that is started again goes on with its run.
        report: Called after every validation.
        cli: The training command.
    """
    enter(sweep.folder, {**sweep.environment, TRAINING_VARIABLE: launch_of(sweep.name, identity)})
    from lightning.pytorch.utilities import rank_zero_only

    from trainer.training import quiet_libraries

    rank_zero_only.rank = int(os.environ.get("RANK", "0"))  # type: ignore[attr-defined]
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "0")) or sweep.group.cpus)
    quiet_libraries()
    training = replace(sweep.training, arguments=(*sweep.training.arguments, *options(values)))
    reporting = Reporting(sweep, identity, report)
    cli.left_out, cli.extra = LEFT_OUT, (reporting,)
    with tempfile.TemporaryDirectory(prefix="penumbra-config-") as folder:
        sys.argv = ["trainer", "fit", *training.restored(Path(folder))]
        cli()
    reporting.finish()


class Reporting(Callback):
    """Measures what a network costs before it is trained, and reports cost and best score.

    What the last epoch gives is reported when the run has ended: a trial whose report falls behind is ended
    at once, and would lack the end of a training that was made to the end.

    Args:
        sweep: What all trials have in common.
        identity: Name of the trial.
        report: Called after every validation, on every rank.
    """

    def __init__(self, sweep: Sweep, identity: str, report: Callable[[dict[str, Any]], None]) -> None:
        self._sweep, self._identity, self._report = sweep, identity, report
        self._cost = float("nan")
        self._best: float | None = None
        self._run, self._epochs = "", 0

    def state_dict(self) -> dict[str, Any]:
        """Return what a trial that is started again needs to know."""
        return {"best": self._best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the state of an earlier attempt."""
        self._best = state_dict["best"]

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measure the cost, and make the run part of the search's."""
        self._cost = ms_per_megapixel(pl_module.net)  # type: ignore[arg-type]
        logger = trainer.logger
        if trainer.is_global_zero and isinstance(logger, MLflowTracking):
            self._run = str(logger.folder)
            tags = {"tune.search": self._sweep.name, "tune.trial": self._identity}
            tags |= {"mlflow.parentRunId": self._sweep.parent} if self._sweep.parent else {}
            logger.set_tags(tags)
            logger.log_metrics({COST: self._cost}, 0)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Note how many epochs were trained."""
        self._epochs = trainer.current_epoch

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report where another validation follows.

        Raises:
            ValueError: The metric is not among what validation logs.
        """
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        found = trainer.callback_metrics
        if self._sweep.metric not in found:
            have = ", ".join(sorted(found)) or "nothing"
            raise ValueError(f"--metric {self._sweep.metric} is not logged by validation, which logs {have}")
        score = float(found[self._sweep.metric])
        pick = max if self._sweep.mode == "max" else min
        self._best = score if self._best is None else pick(self._best, score)
        epoch = trainer.current_epoch + 1
        if epoch + (trainer.check_val_every_n_epoch or 1) <= (trainer.max_epochs or 0):
            self._tell(epoch)

    def finish(self) -> None:
        """Report the end of the training.

        Raises:
            ValueError: There was no validation.
        """
        if self._best is None:
            raise ValueError(
                "no epoch was validated, so that the trial has no score; give a --trainer."
                "check_val_every_n_epoch that is no larger than --trainer.max_epochs"
            )
        self._tell(self._epochs, trained=True)

    def _tell(self, epoch: int, trained: bool = False) -> None:
        numbers = {"score": self._best, "cost": self._cost, "epoch": epoch, "trained": trained}
        self._report({**numbers, "run": self._run, "node": os.uname().nodename})


def ms_per_megapixel(net: Denoiser) -> float:
    """Return the milliseconds per megapixel of a network in its deployed form, on this process's threads.

    The median of the smaller half of some measurements counts, which other work disturbs least.
    """
    from trainer.export.entry import Sampled, example

    deployed = copy.deepcopy(net).deploy().eval().float().cpu()
    samples = Sampled(deployed.samples, 4) if deployed.per_sample else None
    buffers = example(deployed.inputs, 1, SIDE, SIDE, samples=samples)
    times = []
    with torch.inference_mode():
        for _ in range(REPEATS + 1):
            start = time.perf_counter()
            deployed(buffers)
            times.append(time.perf_counter() - start)
    return statistics.median(sorted(times[1:])[: (REPEATS + 1) // 2]) * 1e3 / (SIDE * SIDE / 1e6)
