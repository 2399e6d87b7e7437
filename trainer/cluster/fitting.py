"""`trainer submit`: one training as the ranks of a Ray Train job."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import traceback
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainer.cluster.board import conduct, reason, sending
from trainer.cluster.checked import Training
from trainer.cluster.engine import Cluster, enter, forwarded
from trainer.runs import SUBMITTED

PERMANENT = (ValueError, FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError)
"""What another attempt would meet again: a wrong configuration, a missing file."""


@dataclass(frozen=True)
class Group:
    """The processes of one training.

    Attributes:
        workers: How many.
        cpus: Processor cores of each.
        gpus: GPUs of each.
        max_failures: How often the group is restarted after one of them was lost.
    """

    workers: int = 1
    cpus: int = 1
    gpus: float = 0
    max_failures: int = 3


@dataclass(frozen=True)
class Job:
    """What the ranks of a training get to know.

    Attributes:
        training: Command line and files.
        group: The processes.
        folder: Where they work.
        environment: Variables that they get.
        storage: Where the run is mirrored; None: nowhere.
        launch: Identity of this training; restarted ranks find their run by it.
    """

    training: Training
    group: Group
    folder: str
    environment: dict[str, str]
    storage: str | None
    launch: str


def submit_training(
    training: Training, group: Group, address: str | None, folder: Path, storage: str | None = None
) -> int:
    """Run a training on Ray and print what its first rank prints; returns the exit code.

    Args:
        training: What to train.
        group: On how many processes.
        address: A running Ray, or None for one on this machine.
        folder: Working folder of the processes.
        storage: A folder that all nodes share or an `s3://` address, to which the run is mirrored.

    Raises:
        ValueError: Ray is missing, or the cluster has another release.
        OSError: The cluster cannot be reached.
        KeyboardInterrupt: Ctrl-C, after the job was cancelled.
    """
    launch = f"{SUBMITTED}{uuid.uuid4().hex[:12]}"
    job = Job(training, group, str(folder), forwarded(address), storage, launch)
    return conduct(Cluster(address, group.workers, group.cpus, group.gpus), _Head, job)


class _Head:
    """Conducts a Ray Train job from within the cluster, so that every kind of address works."""

    def run(self, job: Job, board: Any) -> None:
        """Run the ranks, and restart them where one is lost."""
        enter(os.getcwd(), job.environment)  # it trains nothing itself, and this node may lack the folder
        workers = f"{job.group.workers} worker" + ("s" if job.group.workers > 1 else "")
        board.write.remote("stderr", f"starting {workers} ({job.launch})\n")
        import ray.train
        from ray.train.torch import TorchTrainer

        with tempfile.TemporaryDirectory(prefix="penumbra-ray-") as scratch:
            trainer = TorchTrainer(
                run_rank,
                train_loop_config={"job": job, "board": board},
                scaling_config=ray.train.ScalingConfig(
                    num_workers=job.group.workers,
                    use_gpu=job.group.gpus > 0,
                    resources_per_worker=resources(job.group),
                ),
                run_config=ray.train.RunConfig(
                    name="training",
                    storage_path=scratch,
                    failure_config=ray.train.FailureConfig(max_failures=job.group.max_failures),
                    callbacks=[_telling(board, job.group.max_failures)],
                ),
            )
            try:
                trainer.fit()
            except ray.train.TrainingFailedError as error:
                again = job.group.max_failures
                message = f"the training failed {again + 1} times" if again else "the training failed"
                ray.get(board.end.remote(1, f"{message}; the last reason: {_reasons(error)}"))


def resources(group: Group) -> dict[str, float]:
    """Return what one process reserves of its node."""
    return {"CPU": group.cpus, **({"GPU": group.gpus} if group.gpus else {})}


def _telling(board: Any, max_failures: int) -> Any:
    from ray.train import UserCallback

    class Telling(UserCallback):
        """Tells of ranks that were lost."""

        failures = 0

        def after_exception(self, run_context: Any, worker_exceptions: dict[int, Exception]) -> None:
            self.failures += 1
            what = "; ".join(f"rank {r}: {reason(e)}" for r, e in sorted(worker_exceptions.items()))
            then = f"attempt {self.failures + 1} of {max_failures + 1} follows"
            if self.failures > max_failures:
                then = "no attempt is left"
            board.write.remote("stderr", f"lost: {what}; {then}\n")

    return Telling()


def _reasons(error: Any) -> str:
    failures = getattr(error, "worker_failures", None) or {}
    return "; ".join(f"rank {r}: {reason(e)}" for r, e in sorted(failures.items())) or reason(error)


def run_rank(config: dict[str, Any]) -> None:
    """Train as one rank; what can be mended by another attempt is raised, the rest ends the job."""
    job: Job = config["job"]
    board = config["board"]
    import ray

    rank = int(os.environ["RANK"])
    enter(job.folder, {**job.environment, "PENUMBRA_TRAINING": job.launch})
    try:
        if rank == 0:
            with sending(board):
                _train(job, board)
        else:
            _train(job, board)
    except BaseException as error:
        if ray.get(board.cancelled.remote()):
            if rank == 0:  # the others only lost it
                ray.get(board.end.remote(130))
        elif (message := _permanent(error)) is not None:
            ray.get(board.end.remote(1, message if rank == 0 else f"rank {rank}: {message}"))
        else:
            raise
        threading.Event().wait()  # for the end of the group, which would otherwise be started again
    else:
        if rank == 0:
            ray.get(board.end.remote(0))


def _permanent(error: BaseException) -> str | None:
    """Return what to say of a failure that another attempt would meet again, None for all others."""
    from trainer.cli import foreseen

    if isinstance(error, PERMANENT):
        return str(error)
    if isinstance(error, Exception) and type(error).__name__ == "MisconfigurationException":
        return foreseen(error)
    if os.environ.get("PENUMBRA_TRACEBACK"):
        traceback.print_exc()
    return None


def _train(job: Job, board: Any) -> None:
    import torch
    from lightning.pytorch.utilities import rank_zero_only

    from trainer.cluster.restoring import share_newest
    from trainer.cluster.worker import Cancelling, RayTrainingCLI
    from trainer.training import quiet_libraries

    if threads := os.environ.get("OMP_NUM_THREADS"):
        torch.set_num_threads(int(threads))
    rank_zero_only.rank = int(os.environ["RANK"])  # type: ignore[attr-defined]
    quiet_libraries()
    if share_newest(Path(job.training.root), job.training.experiment, job.storage):
        return  # the process that was lost had nothing left to do
    with tempfile.TemporaryDirectory(prefix="penumbra-config-") as folder:
        arguments = job.training.restored(Path(folder))
        sys.argv = ["trainer", "fit", *arguments]
        RayTrainingCLI.gpus = job.group.gpus
        RayTrainingCLI.extra = (Cancelling(board), *_mirrors(job.storage))
        RayTrainingCLI()


def _mirrors(storage: str | None) -> list[Any]:
    from trainer.callbacks.mirror import MirrorRun

    return [MirrorRun(storage)] if storage else []
