"""The folder of an ablation and its run in MLflow, below which the runs of its variants are."""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from trainer.ablation.fitting import Fitted
from trainer.ablation.plan import Ablation
from trainer.ablation.variants import Training
from trainer.outputs import make_folder, write_whole
from trainer.runs import RUN_FILE, RunRecord
from trainer.spool.store import described, tracking_uri
from trainer.tracking import MLflowTracking

RECORD, STATES = "ablation.json", "variants.json"
WAIT_S = 30.0
"""Seconds that an ablation waits for the tracking store before its first training."""


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Make a folder and keep other processes from working in it; the system lets go when this one ends.

    Raises:
        ValueError: Another process works in it, or it is a file.
        OSError: It cannot be made or written to.
    """
    make_folder(folder)
    file = os.open(folder, os.O_RDONLY)  # no file of a lock is left in it
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"another process is at work in {folder}; wait until it is done, or choose another --output"
            ) from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(file)


def take_folder(folder: Path, name: str) -> str:
    """Begin an ablation in an empty folder, or find the one that is to go on; returns its identifier.

    Raises:
        ValueError: It holds another ablation, or something else.
        OSError: It cannot be written to.
    """
    path = folder / RECORD
    if path.is_file():
        try:
            held = json.loads(path.read_text())
            identity, other = str(held["id"]), str(held["name"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}; choose another --output") from None
        if other != name:
            raise ValueError(f"{folder} holds the ablation {other}, not {name}; choose another --output")
        return identity
    if any(folder.iterdir()):
        raise ValueError(f"{folder} holds something else than an ablation; choose another --output")
    identity = uuid.uuid4().hex
    write_whole(path, json.dumps({"id": identity, "name": name}) + "\n")
    return identity


class ParentRun:
    """The run, recorded in the ablation's folder as every run is.

    Args:
        ablation: What is compared.
        trainings: What its variants train.
        folder: Of the ablation; one that is resumed has a run already.
        say: Told where the store cannot be reached.
    """

    def __init__(
        self, ablation: Ablation, trainings: Sequence[Training], folder: Path, say: Callable[[str], None]
    ) -> None:
        first = trainings[0]
        if not (folder / RUN_FILE).exists():
            uri = tracking_uri(first.tracking_uri, first.root)
            RunRecord(first.experiment, f"ablation {folder.resolve().name}", uri).save(folder)
        self._folder = folder
        self._logger = MLflowTracking(
            first.experiment, root=str(first.root), system_metrics=False, resume_from=str(folder)
        )
        self._logger.set_tags({"ablation": ablation.name})
        self._logger.log_params({"title": ablation.title, "data": first.data, "variants": len(trainings)})
        self._logger.flush(WAIT_S)
        self.run_id = self._logger.run_id
        """Identifier in the tracking store, empty where that cannot be reached: variants then stand alone."""
        if not self.run_id:
            say(
                f"note: {described(self._logger.uri)} cannot be reached; the runs of the variants will not "
                "be nested below that of the ablation"
            )

    def tags(self) -> dict[str, str]:
        """Return the tags that put a run below this one."""
        return {"mlflow.parentRunId": self.run_id} if self.run_id else {}

    def note(self, fitted: Sequence[Fitted]) -> None:
        """Write what became of the variants into `variants.json`."""
        states = [
            {
                "name": one.name,
                "state": "trained" if one.run is not None else "failed",
                "reason": one.reason or None,
                "run": None if one.run is None else str(one.run.resolve()),
                "options": dict(one.training.variant.options),
            }
            for one in fitted
        ]
        write_whole(self._folder / STATES, json.dumps(states, indent=1) + "\n")

    def keep(self) -> None:
        """Record tables and plots."""
        for place in ("tables", "plots"):
            for path in sorted((self._folder / place).glob("*")):
                self._logger.log_file(path, place)

    def end(self, good: bool) -> None:
        """End the run, well where every variant is in the tables."""
        self._logger.finalize("success" if good else "failed")
