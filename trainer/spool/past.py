"""The journal of a run that was tracked before there were journals, from what its store holds."""

from __future__ import annotations

import os
import tempfile
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.runs import RunRecord
from trainer.spool.failures import reason
from trainer.spool.journal import JOURNAL, SPOOL, Event, Journal, events, number
from trainer.spool.sent import Sent
from trainer.spool.store import described, open_client

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

KEPT_TAG = "mlflow.loggedImages"
"""The one of MLflow's own tags that a copy needs: it makes the run's page show pictures."""
PARTIAL = f".{JOURNAL}.tmp"


def is_whole(folder: Path) -> bool:
    """Return whether the journal of a run folder holds everything that its store does.

    A run that began before there were journals has none, or one that begins where it was continued.
    """
    first, _ = next(events(folder), ({}, 0))
    if not first:
        return False
    return bool(first.get("past")) or RunRecord.load(folder).run_id is None or Sent.load(folder).created


def write_journal(folder: Path) -> None:
    """Write the journal of a run folder from its store, and behind that what its journal holds already.

    The journal appears when it is complete: files are kept under names of their contents, so that a writing
    that was interrupted is repeated without harm. What both hold is the same to the next store.

    Raises:
        ValueError: The store cannot be read, or does not have the run.
    """
    from mlflow.exceptions import MlflowException

    record = RunRecord.load(folder)
    if record.run_id is None:
        raise ValueError(f"{folder} has recorded nothing that could be sent")
    try:
        client = open_client(record.tracking_uri or "")
        run = client.get_run(record.run_id)
        (folder / SPOOL / PARTIAL).unlink(missing_ok=True)
        journal = Journal(folder, name=PARTIAL)
        _write_run(journal, client, run, folder)
    except MlflowException as error:
        raise ValueError(
            f"{folder} began before there were journals, and what it recorded then cannot be read from "
            f"{described(record.tracking_uri or '')} ({reason(error)}); nothing was sent"
        ) from error
    if not journal.flush():
        raise OSError(f"cannot write {journal.path}: the disk is full; nothing was sent")
    journal.close()
    os.replace(journal.path, folder / SPOOL / JOURNAL)


def _write_run(journal: Journal, client: MlflowClient, run: Run, folder: Path) -> None:
    newer = [event for event, _ in events(folder)]
    identity = next((event["id"] for event in newer if event["type"] == "run"), uuid.uuid4().hex)
    journal.append({"t": run.info.start_time, "type": "run", "id": identity, "past": True})
    if run.data.params:
        journal.append({"type": "params", "values": dict(run.data.params)})
    tags = {k: v for k, v in run.data.tags.items() if not k.startswith("mlflow.") or k == KEPT_TAG}
    if tags:
        journal.append({"type": "tags", "values": tags})
    _write_metrics(journal, client, run)
    _write_artifacts(journal, client, run)
    if not any(event["type"] == "model" for event in newer):
        _write_models(journal, folder)
    if run.info.status != "RUNNING":
        journal.append({"t": run.info.end_time, "type": "status", "status": run.info.status})
    for event in newer:
        if not event.get(
            "evaluation"
        ):  # it has not set the status of this run, and is not to do so elsewhere
            journal.append(event)


def _write_metrics(journal: Journal, client: MlflowClient, run: Run) -> None:
    moments: dict[tuple[int, int], dict[str, float | str]] = {}
    for key in run.data.metrics:
        for metric in client.get_metric_history(run.info.run_id, key):
            moments.setdefault((metric.timestamp, metric.step), {})[key] = number(metric.value)
    for (time, step), values in sorted(moments.items()):
        journal.append({"t": time, "type": "metrics", "step": step, "values": values})


def _write_artifacts(journal: Journal, client: MlflowClient, run: Run) -> None:
    if not client.list_artifacts(run.info.run_id):
        return
    with tempfile.TemporaryDirectory() as folder:
        client.download_artifacts(run.info.run_id, "", folder)
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file():
                to = path.relative_to(folder).as_posix()
                journal.append({"type": "file", "to": to, **journal.keep(path)})


def _write_models(journal: Journal, folder: Path) -> None:
    """Have the models registered that the run exported."""
    for path in sorted((folder / "export").glob("*.onnx")):
        kept = journal.keep(path)
        event: Event = {"type": "model", "name": path.stem, "weights": kept["sha256"][:32]}
        journal.append(event | kept)
