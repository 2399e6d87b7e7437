"""An evaluation in MLflow: one run with tables and pictures, and a run below it for each method."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pandas as pd

from trainer.evaluation.champion import version_of
from trainer.evaluation.keeping import id_of
from trainer.evaluation.plan import INPUT
from trainer.evaluation.running import Outcome
from trainer.evaluation.tables import AVERAGE, Scored
from trainer.runs import RunRecord, folder_of_checkpoint
from trainer.spool.store import experiment_id, is_server, open_client, tracking_uri

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

EXPERIMENT = "evaluations"
PARENT, CHILD = "mlflow.parentRunId", "penumbra.method"
EVALUATION, CONTENT = "penumbra.evaluation", "penumbra.content"
"""Tags that name an evaluation, and what a method's run holds."""
FILES = ("evaluation.json", "rows.parquet", "rows.csv", "report.html")
FOLDERS = ("tables", "plots", "pictures")
NOTE_LENGTH = 7000
"""Characters of a run's description; stores take 8000."""
BATCH = 1000
"""Metrics of one request, which MLflow limits."""


@dataclass(frozen=True)
class Tracked:
    """The runs of an evaluation.

    Attributes:
        uri: The store.
        experiment: Identifier of the experiment there.
        runs: Label → identifier of the method's run; that of the evaluation under the empty label.
    """

    uri: str
    experiment: str
    runs: dict[str, str]

    def url(self, label: str = "") -> str | None:
        """Return the address of a run's page; None where the store is no server."""
        run = self.runs.get(label)
        return page_of(self.uri, self.experiment, run) if run else None


def page_of(uri: str, experiment: str, run: str) -> str | None:
    """Return the address of the page of a run, None where the store is no server.

    A name and password in the address of the server are left out.
    """
    if not is_server(uri):
        return None
    parts = urlsplit(uri)
    plain = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl().rstrip("/")
    return f"{plain}/#/experiments/{experiment}/runs/{run}"


def track(
    folder: Path,
    outcomes: Sequence[Outcome],
    rows: pd.DataFrame,
    metrics: Sequence[str],
    uri: str | None = None,
) -> Tracked:
    """Record what methods reached, in the runs that the evaluation has already or in new ones.

    Args:
        folder: Of the evaluation.
        outcomes: Of all methods.
        rows: One per frame and method.
        metrics: Names of those that were taken.
        uri: The store; by default `MLFLOW_TRACKING_URI` or the local one.

    Raises:
        MlflowException: The store cannot be used.
        OSError: Likewise.
    """
    store = tracking_uri(uri)
    client = open_client(store)
    experiment = experiment_id(client, store, EXPERIMENT)
    parent = _evaluation_run(client, experiment, folder)
    scored = Scored(rows, [outcome.method.label for outcome in outcomes], metrics)
    _log(client, parent, _about(rows), {})
    found = {"": parent}
    before = _children(client, experiment, parent)
    for outcome in outcomes:
        label = outcome.method.label
        params, values = _params(outcome), _means(scored, label)
        content = hashlib.sha256(json.dumps([outcome.status, params, values]).encode()).hexdigest()
        tags = {PARENT: parent, CHILD: label, CONTENT: content, "penumbra.status": outcome.status}
        if told := outcome.told():
            tags["penumbra.reason"] = told[:5000]
        if trained := training_run(outcome.method.model, store):
            tags["penumbra.training_run"] = trained[1]
        child = before.get((label, content))
        if child is None:
            child = str(client.create_run(experiment, run_name=label, tags=tags).info.run_id)
            _log(client, child, params, values)
        found[label] = child
        client.set_terminated(child, "FINISHED" if outcome.status == "done" else "FAILED")
    for run in set(before.values()) - set(found.values()):
        client.delete_run(run)  # of methods that were taken out, or whose results are others now
    return Tracked(store, experiment, found)


def _evaluation_run(client: MlflowClient, experiment: str, folder: Path) -> str:
    """Return the run of the evaluation in a folder, made if there is none."""
    told = f"tags.`{EVALUATION}` = '{id_of(folder)}'"
    there = client.search_runs([experiment], told, max_results=1)
    if there:
        return str(there[0].info.run_id)
    tags = {EVALUATION: id_of(folder), "penumbra.folder": str(folder.resolve())[:5000]}
    return str(client.create_run(experiment, run_name=folder.resolve().name, tags=tags).info.run_id)


def _children(client: MlflowClient, experiment: str, parent: str) -> dict[tuple[str, str], str]:
    """Return label and content → identifier of the runs of methods."""
    runs = client.search_runs([experiment], f"tags.`{PARENT}` = '{parent}'", max_results=BATCH)
    return {(run.data.tags.get(CHILD, ""), run.data.tags.get(CONTENT, "")): run.info.run_id for run in runs}


def keep_files(tracked: Tracked, folder: Path) -> None:
    """Send page, rows, tables, plots and pictures of an evaluation to its run, and end that.

    Raises:
        MlflowException: The store cannot be used.
        OSError: Likewise, or a file is missing.
    """
    client, parent = open_client(tracked.uri), tracked.runs[""]
    for name in FILES:
        if (folder / name).is_file():
            client.log_artifact(parent, str(folder / name))
    for name in FOLDERS:
        if (folder / name).is_dir():
            client.log_artifacts(parent, str(folder / name), name)
    client.set_tag(parent, "mlflow.note.content", _note(folder))
    client.set_terminated(parent, "FINISHED")


def _note(folder: Path) -> str:
    """Return the description of the run, which its page shows: as many overviews as it may hold."""
    texts = [path.read_text() for path in sorted((folder / "tables").glob("overview_*.md"))]
    note = ""
    for text in texts:
        if len(note) + len(text) < NOTE_LENGTH:
            note += text + "\n"
    return note


def training_run(model: str, store: str) -> tuple[str, str] | None:
    """Return the store and the identifier of the run that trained a model, None where that is not known."""
    from mlflow.exceptions import MlflowException

    try:
        if match := re.match(r"runs:/+([^/]+)", model):
            return store, match[1]
        if named := version_of(model, store):
            run = open_client(store).get_model_version(*named).run_id
            return (store, run) if run else None
        path = Path(model)
        folder = path if path.is_dir() else folder_of_checkpoint(path)
        record = RunRecord.load(folder) if folder is not None and path.exists() else None
    except (MlflowException, ValueError, OSError):
        return None  # whoever loads it has said so
    return (record.tracking_uri, record.run_id) if record and record.tracking_uri and record.run_id else None


def training_url(model: str, store: str) -> str | None:
    """Return the address of the page of the run that trained a model, None where there is none."""
    from mlflow.exceptions import MlflowException

    found = training_run(model, store)
    if found is None or not is_server(found[0]):
        return None
    try:
        experiment = open_client(found[0]).get_run(found[1]).info.experiment_id
    except (MlflowException, OSError):
        return None
    return page_of(found[0], experiment, found[1])


def _about(rows: pd.DataFrame) -> dict[str, str]:
    frames = rows[rows["method"] == INPUT]
    scenes = ", ".join(dict.fromkeys(frames["scene"].dropna().astype(str)))
    return {"frames": str(len(frames)), "scenes": scenes[:500]}


def _params(outcome: Outcome) -> dict[str, str]:
    facts = outcome.facts
    known = {
        "model": outcome.method.model,
        "class": facts.get("class"),
        "parameters": facts.get("parameters"),
    }
    options = {f"option.{name}": value for name, value in (facts.get("options") or {}).items()}
    return {name: str(value)[:500] for name, value in {**known, **options}.items() if value is not None}


def _means(scored: Scored, label: str) -> dict[str, float]:
    """Return `metric` averaged over scenes and `metric/scene`."""
    values = {}
    for metric in scored.metrics:
        cells = {AVERAGE: scored.average(label, metric)}
        cells |= {scene: scored.cell(label, metric, scene) for scene in scored.scenes}
        for place, cell in cells.items():
            if cell.count and math.isfinite(cell.mean):
                values[metric if place == AVERAGE else f"{metric}/{_plain(place)}"] = cell.mean
    return values


def _plain(name: str) -> str:
    """Return a name with those letters only that names of metrics may have."""
    return re.sub(r"[^/\w.\- :]", "_", name)[:200]


def _log(client: MlflowClient, run: str, params: Mapping[str, str], values: Mapping[str, float]) -> None:
    import time

    from mlflow.entities import Metric, Param

    known: dict[str, Any] = client.get_run(run).data.params
    new = [Param(name, value) for name, value in params.items() if name not in known]
    now = int(1000 * time.time())
    metrics = [Metric(name, value, now, 0) for name, value in values.items()]
    client.log_batch(run, params=new[:100])
    for start in range(0, len(metrics), BATCH):
        client.log_batch(run, metrics=metrics[start : start + BATCH])
