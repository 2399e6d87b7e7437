"""The journal of a run that was tracked before there were journals, from what its local store holds."""

from __future__ import annotations

import tempfile
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.runs import RunRecord
from trainer.spool.journal import Journal, number
from trainer.spool.store import open_client

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

KEPT_TAG = "mlflow.loggedImages"
"""The one of MLflow's own tags that a copy needs: it makes the run's page show pictures."""


def write_journal(folder: Path) -> None:
    """Write the journal of a run folder from its local store.

    Raises:
        MlflowException: The store does not have the run.
    """
    record = RunRecord.load(folder)
    client = open_client(record.tracking_uri or "")
    run = client.get_run(record.run_id or "")
    journal = Journal(folder)
    journal.append({"t": run.info.start_time, "type": "run", "id": uuid.uuid4().hex})
    if run.data.params:
        journal.append({"type": "params", "values": dict(run.data.params)})
    tags = {k: v for k, v in run.data.tags.items() if not k.startswith("mlflow.") or k == KEPT_TAG}
    if tags:
        journal.append({"type": "tags", "values": tags})
    _write_metrics(journal, client, run)
    _write_artifacts(journal, client, run)
    for path in sorted((folder / "export").glob("*.onnx")):
        kept = journal.keep(path)
        journal.append({"type": "model", "name": path.stem, "weights": kept["sha256"][:32], **kept})
    if run.info.status != "RUNNING":
        journal.append({"t": run.info.end_time, "type": "status", "status": run.info.status})
    journal.close()


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
