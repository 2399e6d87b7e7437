"""`trainer upload`: send a run that was tracked locally to a tracking server."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.runs import RunRecord

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

HELP = "Send a run that was tracked in the local store to a tracking server."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `trainer upload`."""
    parser.add_argument("run", type=Path, help="folder of the run, runs/EXPERIMENT/NAME")
    parser.add_argument(
        "--to",
        metavar="URI",
        help="server; by default the one that could not be reached, or MLFLOW_TRACKING_URI",
    )


def run(arguments: argparse.Namespace) -> int:
    """Copy metrics, parameters, tags, artifacts and the registered model; then follow the server's run.

    Raises:
        ValueError: The folder is no run, no server is named, or it does not answer.
    """
    from trainer.tracking import experiment_id, is_server, open_client, unreachable

    record = RunRecord.load(arguments.run)
    target = arguments.to or record.unreached_uri or os.environ.get("MLFLOW_TRACKING_URI")
    if not target:
        raise ValueError("no server is known for this run; name one with --to URI")
    if record.tracking_uri == target:
        print(f"{arguments.run} is tracked by {target} already")
        return 0
    if is_server(target) and (reason := unreachable(target)):
        raise ValueError(f"the tracking server {target} cannot be reached ({reason}); nothing was sent")
    source, sink = open_client(record.tracking_uri or ""), open_client(target)
    run_id = record.server_run_id
    if run_id is None:
        experiment = experiment_id(sink, target, record.experiment)
        run_id = sink.create_run(experiment, run_name=record.name).info.run_id
        record.server_run_id = run_id
        record.save(arguments.run)  # an upload that is interrupted continues in the same run
    local = source.get_run(record.run_id or "")
    metrics = _copy_numbers(source, sink, local, run_id)
    files = _copy_artifacts(source, sink, local, run_id)
    _register(sink, target, run_id, arguments.run)
    sink.set_terminated(run_id, local.info.status)
    record.tracking_uri, record.run_id = target, run_id
    record.unreached_uri = record.server_run_id = None
    record.save(arguments.run)
    print(f"sent {metrics} metric values and {files} files to {target}, run {run_id}")
    return 0


def _copy_numbers(source: MlflowClient, sink: MlflowClient, local: Run, run_id: str) -> int:
    from mlflow.entities import Param

    present = sink.get_run(run_id).data
    params = [Param(k, v) for k, v in local.data.params.items() if k not in present.params]
    for start in range(0, len(params), 100):
        sink.log_batch(run_id, params=params[start : start + 100])
    for key, value in local.data.tags.items():
        if not key.startswith("mlflow.") and present.tags.get(key) != value:
            sink.set_tag(run_id, key, value)
    count = 0
    for key in local.data.metrics:
        known = {(m.step, m.timestamp) for m in sink.get_metric_history(run_id, key)}
        history = [m for m in source.get_metric_history(local.info.run_id, key)
                   if (m.step, m.timestamp) not in known]  # fmt: skip
        for start in range(0, len(history), 1000):
            sink.log_batch(run_id, metrics=history[start : start + 1000])
        count += len(history)
    return count


def _copy_artifacts(source: MlflowClient, sink: MlflowClient, local: Run, run_id: str) -> int:
    with tempfile.TemporaryDirectory() as folder:
        if not source.list_artifacts(local.info.run_id):
            return 0
        source.download_artifacts(local.info.run_id, "", folder)
        sink.log_artifacts(run_id, folder)
        return sum(path.is_file() for path in Path(folder).rglob("*"))


def _register(sink: MlflowClient, target: str, run_id: str, folder: Path) -> None:
    """Register the exported model on the server, unless that run registered it before."""
    from trainer.export.register import log_and_register

    for path in sorted((folder / "export").glob("*.onnx")):
        if not any(v.run_id == run_id for v in sink.search_model_versions(f"name='{path.stem}'")):
            version = log_and_register(run_id, path, path.stem, target)
            print(f"registered models:/{path.stem}/{version}", file=sys.stderr)
