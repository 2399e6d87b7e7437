"""Where a run lives on disk, and how an earlier one is found again.

    runs/mlflow.db                       the local tracking store
    runs/artifacts/                      its artifacts
    runs/<experiment>/<run name>/        one run: run.json, config.yaml, checkpoints/, export/, pictures/

This module imports nothing heavy.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

RUN_FILE = "run.json"


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
        partial = folder / f".{RUN_FILE}.{os.getpid()}.tmp"
        partial.write_text(json.dumps(asdict(self), indent=1) + "\n")
        os.replace(partial, folder / RUN_FILE)

    @classmethod
    def load(cls, folder: Path) -> RunRecord:
        """Read the record of a run folder.

        Raises:
            ValueError: The folder is not a run, or its record is damaged.
        """
        path = folder / RUN_FILE
        try:
            return cls(**json.loads(path.read_text()))
        except FileNotFoundError:
            raise ValueError(f"{folder} is not a run folder: it has no {RUN_FILE}") from None
        except (json.JSONDecodeError, TypeError) as error:
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
    """Return the checkpoint that `word` means: `last`, `best`, a run folder or a file.

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
