"""An evaluation in MLflow: one run with tables and pictures, and a run below it for each method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from trainer.evaluation.running import Outcome
from trainer.evaluation.tables import AVERAGE, Scored
from trainer.spool.store import experiment_id, open_client, tracking_uri

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

EXPERIMENT = "evaluations"
PARENT, CHILD = "mlflow.parentRunId", "penumbra.method"
FILES = ("evaluation.json", "rows.parquet", "rows.csv", "report.html")
BATCH = 1000
"""Metrics of one request, which MLflow limits."""


def track(
    folder: Path,
    outcomes: Sequence[Outcome],
    rows: pd.DataFrame,
    metrics: Sequence[str],
    uri: str | None = None,
) -> dict[str, str]:
    """Record an evaluation, in the runs that it has already or in new ones.

    Args:
        folder: Of the evaluation, whose files become artifacts.
        outcomes: Of all methods.
        rows: One per frame and method.
        metrics: Names of those that were taken.
        uri: The store; by default `MLFLOW_TRACKING_URI` or the local one.

    Returns:
        Label → identifier of the method's run; that of the evaluation under the empty label.

    Raises:
        MlflowException: The store cannot be used.
        OSError: Likewise, or a file is missing.
    """
    store = tracking_uri(uri)
    client = open_client(store)
    experiment = experiment_id(client, store, EXPERIMENT)
    parent = _run(client, experiment, folder.resolve().name, {"penumbra.evaluation": str(folder.resolve())})
    scored = Scored(rows, [outcome.method.label for outcome in outcomes], metrics)
    found = {"": parent}
    for outcome in outcomes:
        label = outcome.method.label
        tags = {PARENT: parent, CHILD: label, "penumbra.status": outcome.status}
        if told := outcome.told():
            tags["penumbra.reason"] = told[:5000]
        found[label] = child = _run(client, experiment, label, tags)
        _log(client, child, _params(outcome), _means(scored, label))
        client.set_terminated(child, "FINISHED" if outcome.status == "done" else "FAILED")
    for name in FILES:
        if (folder / name).is_file():
            client.log_artifact(parent, str(folder / name))
    client.log_artifacts(parent, str(folder / "tables"), "tables")
    if (folder / "pictures").is_dir():
        client.log_artifacts(parent, str(folder / "pictures"), "pictures")
    client.set_terminated(parent, "FINISHED")
    return found


def _run(client: MlflowClient, experiment: str, name: str, tags: Mapping[str, str]) -> str:
    """Return the run with these tags, made if there is none."""
    key = CHILD if CHILD in tags else "penumbra.evaluation"
    told = [f"tags.`{key}` = '{_quoted(tags[key])}'"]
    if PARENT in tags:
        told.append(f"tags.`{PARENT}` = '{tags[PARENT]}'")
    there = client.search_runs([experiment], " and ".join(told), max_results=1)
    if not there:
        return str(client.create_run(experiment, run_name=name, tags=dict(tags)).info.run_id)
    for tag, value in tags.items():
        client.set_tag(there[0].info.run_id, tag, value)
    return str(there[0].info.run_id)


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace("'", "\\'")


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
                values[metric if place == AVERAGE else f"{metric}/{place}"] = cell.mean
    return values


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
