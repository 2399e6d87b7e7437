"""Where a run lives on disk, and how an earlier one is found again.

    runs/mlflow.db                       the local tracking store
    runs/artifacts/                      its artifacts
    runs/<experiment>/<run name>/        one run: run.json, config.yaml, checkpoints/, export/, pictures/

A launch is what restarts a training that was killed: `torchrun --max-restarts`, a Ray job, a Slurm job that
is requeued. The run that it trains says so in `launch.json`, so that a restart finds it again. A script that
one launch runs may train several times: the command line tells these trainings from each other.

This module imports nothing heavy.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from trainer import configs

RUN_FILE = "run.json"
LAUNCH_FILE = "launch.json"
LAUNCH_VARIABLE = "PENUMBRA_LAUNCH"
"""Names a launch."""
TRAINING_VARIABLE = "PENUMBRA_TRAINING"
"""Names one training whatever its command line: that of a Ray worker names other files every time."""
SUBMITTED = "submit "
"""How names begin that are given once."""


@dataclass
class RunRecord:
    """What is needed to continue a run, kept in its folder as `run.json`.

    Attributes:
        experiment: Name of the experiment.
        name: Name of the run, also of its folder.
        tracking_uri: Store that holds the run.
        run_id: Identifier in that store.
        unreached_uri: Server that could not be reached, if any; `trainer upload` sends the run there.
        server_run_id: Run on that server that holds the part before the connection broke.
    """

    experiment: str
    name: str
    tracking_uri: str | None = None
    run_id: str | None = None
    unreached_uri: str | None = None
    server_run_id: str | None = None

    def save(self, folder: Path) -> None:
        """Write the record whole or not at all."""
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / RUN_FILE, asdict(self))

    @classmethod
    def load(cls, folder: Path) -> RunRecord:
        """Read the record of a run folder.

        Raises:
            ValueError: The folder is not a run, or its record is damaged.
        """
        path = folder / RUN_FILE
        try:
            record = cls(**json.loads(path.read_text()))
            if wrong := [name for name, value in asdict(record).items() if not isinstance(value, str | None)]:
                raise ValueError(f"{wrong[0]} is no text")
            return record
        except FileNotFoundError:
            raise ValueError(f"{folder} is not a run folder: it has no {RUN_FILE}") from None
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is damaged: {error}") from None


def new_name(now: datetime | None = None) -> str:
    """Return a name that sorts by time."""
    return (now or datetime.now()).strftime("%Y%m%d-%H%M%S")


def new_folder(root: Path, experiment: str) -> Path:
    """Create the folder of a new run below `root/experiment` and return it.

    Two runs that start in the same second get different folders.
    """
    name = new_name()
    for number in range(1000):
        folder = root / experiment / (name if number == 0 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise OSError(f"cannot find a free run name below {root / experiment}")


def run_folders(root: Path, experiment: str) -> list[Path]:
    """Return the run folders of an experiment, oldest first."""
    return sorted(path.parent for path in (root / experiment).glob(f"*/{RUN_FILE}"))


def find_checkpoint(word: str, root: Path, experiment: str) -> Path:
    """Return the checkpoint that `word` means: `last`, `best`, a run folder or a file, or the URL of one.

    `last` and `best` are taken from the newest run of the experiment that has such a checkpoint.

    Raises:
        ValueError: There is no such checkpoint; the message says where it was looked for.
    """
    if word in ("last", "best"):
        for folder in reversed(run_folders(root, experiment)):
            path = folder / "checkpoints" / f"{word}.ckpt"
            if path.is_file():
                return path
        raise ValueError(
            f"--ckpt_path {word}: no run of {experiment!r} below {root / experiment} has a {word} "
            "checkpoint; give the path of a checkpoint, or leave the option out to start anew"
        )
    if "://" in word:
        from trainer.cluster.storage import fetch_checkpoint

        return fetch_checkpoint(word, root)
    path = Path(word)
    if path.is_dir():
        path = path / "checkpoints" / "last.ckpt"
    if not path.is_file():
        raise ValueError(f"--ckpt_path {word}: no such file (words that work: last, best)")
    return path


def folder_of_checkpoint(checkpoint: Path) -> Path | None:
    """Return the run folder that a checkpoint lies in, None where it was moved out of one."""
    for folder in checkpoint.resolve().parents[:2]:
        if (folder / RUN_FILE).is_file():
            return folder
    return None


@dataclass(frozen=True)
class Launch:
    """A training, as what started this process names it and starts it again when it is killed.

    Attributes:
        identity: The same in every process of the training and after every restart.
        restarts: Whether this is a restart, as far as that can be told.
        unfinished: Continue a run of the same identity that did not finish, even if nothing says that this is
            a restart: who names a launch means that.
        since: When this launch began, in seconds since 1970, as far as that is known; a run that ended before
            is that of an earlier launch of the same name.
    """

    identity: str
    restarts: bool = False
    unfinished: bool = False
    since: float = 0.0

    @property
    def once(self) -> bool:
        """Whether there is nothing left to do where a run of the same identity is finished.

        A restart may have come for a process that died after the end of the training.
        """
        return self.restarts or self.identity.startswith(SUBMITTED)


def current_launch(
    environment: Mapping[str, str] = os.environ, arguments: Sequence[str] | None = None
) -> Launch | None:
    """Return the launch and training that this process belongs to, None if nothing would restart it.

    `PENUMBRA_LAUNCH` names a launch; otherwise torchrun's `--rdzv-id`; otherwise the job of Slurm; otherwise,
    on one machine, the process of torchrun.

    Args:
        environment: Variables of this process.
        arguments: Its command line without the program, that of `sys.argv` where None.
    """
    if training := environment.get(TRAINING_VARIABLE):
        return Launch(training, unfinished=True)
    what = _digest(sys.argv[1:] if arguments is None else arguments)
    restarts = environment.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"
    since = _agent().create_time() if restarts else 0.0
    if named := environment.get(LAUNCH_VARIABLE):
        return Launch(f"{named} {what}", restarts, unfinished=True, since=since)
    torchrun = environment.get("TORCHELASTIC_RUN_ID")
    if torchrun and torchrun != "none":  # its default
        return Launch(f"torchrun {torchrun} {what}", restarts, unfinished=True, since=since)
    if "SLURM_JOB_ID" in environment:
        requeued = environment.get("SLURM_RESTART_COUNT", "0") != "0"
        return Launch(f"slurm {environment['SLURM_JOB_ID']} {what}", restarts or requeued)
    if torchrun and environment.get("WORLD_SIZE") != environment.get("LOCAL_WORLD_SIZE"):
        if environment.get("RANK") == "0":
            _warn_of_nameless_launch()
        return None
    if torchrun:
        agent = _agent()
        place = f"{socket.gethostname()} {agent.pid} {agent.create_time():.2f}"
        return Launch(f"torchrun {place} {what}", restarts)
    return None


def _agent() -> Any:
    """Return the process of torchrun that started this one."""
    import psutil

    return psutil.Process(os.getppid())


def _digest(arguments: Sequence[str]) -> str:
    """Return what stands for a command line, the same on machines with other places of installation."""
    line = json.dumps([argument.replace(str(configs.folder()), "") for argument in arguments])
    return hashlib.sha256(line.encode()).hexdigest()[:12]


@functools.cache  # once
def _warn_of_nameless_launch() -> None:
    print(
        "this torchrun on several machines has no --rdzv-id, so that a restart would begin a new run; give "
        f"it one, or set {LAUNCH_VARIABLE} to the same name on all machines",
        file=sys.stderr,
    )


def begin_launch(folder: Path, launch: Launch, checkpoint: str | None = None) -> None:
    """Note in a run's folder that a launch trains it.

    Args:
        folder: The run's.
        launch: The launch.
        checkpoint: What it starts from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    start = {"attempt": attempt_of(folder) + 1, "checkpoint": checkpoint, "last": _stamp(folder)}
    _write(folder / LAUNCH_FILE, {"launch": launch.identity, "finished": False, **start})


def noted_launch(folder: Path) -> dict[str, object]:
    """Return what `begin_launch` and `end_launch` noted of a run, nothing where that is absent or damaged."""
    return _read(folder / LAUNCH_FILE)


def attempt_of(folder: Path) -> int:
    """Return how often a run was begun or continued by launches, 0 where none is noted."""
    number = noted_launch(folder).get("attempt")
    return number if isinstance(number, int) else 0


def checkpoint_of_launch(folder: Path) -> Path | None:
    """Return what a restarted launch goes on from: the last checkpoint it saved, or what it started from.

    None where it started from nothing and has saved none.
    """
    noted = noted_launch(folder)
    if _stamp(folder) not in (None, noted.get("last")):
        return _last(folder)
    start = noted.get("checkpoint")
    return Path(start) if isinstance(start, str) else None


def _last(folder: Path) -> Path:
    return folder / "checkpoints" / "last.ckpt"


def _stamp(folder: Path) -> int | None:
    """Return when a run's last checkpoint was written, None where there is none."""
    path = _last(folder)
    return path.stat().st_mtime_ns if path.is_file() else None


def end_launch(folder: Path) -> None:
    """Note that the launch of a run has nothing left to do, so that it is not continued."""
    path = folder / LAUNCH_FILE
    if path.is_file():
        _write(path, {**_read(path), "finished": True})


def run_of_launch(launch: Launch, root: Path, experiment: str) -> Path | None:
    """Return the run folder that a launch is to go on with, None where it is to begin a new run."""
    if not (launch.restarts or launch.unfinished):
        return None
    return _noted_as(launch, root, experiment, finished=False)


def finished_by_launch(launch: Launch, root: Path, experiment: str) -> Path | None:
    """Return the run folder that shows that a launch has nothing left to do, None where it has."""
    folder = _noted_as(launch, root, experiment, finished=True) if launch.once else None
    ended = (folder / LAUNCH_FILE).stat().st_mtime if folder is not None else 0.0
    return folder if ended >= launch.since else None


def _noted_as(launch: Launch, root: Path, experiment: str, finished: bool) -> Path | None:
    for folder in reversed(run_folders(root, experiment)):
        noted = noted_launch(folder)
        if noted.get("launch") == launch.identity and bool(noted.get("finished")) is finished:
            return folder
    return None


def _write(path: Path, record: Mapping[str, object]) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    partial.write_text(json.dumps(record, indent=1) + "\n")
    os.replace(partial, path)


def _read(path: Path) -> dict[str, object]:
    """Return what a launch noted; nothing where the file is absent or damaged."""
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}
