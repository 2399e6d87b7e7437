"""A search on a cluster of two nodes."""

import json

import pytest
import yaml

from trainer.tracking import open_client

pytestmark = pytest.mark.slow

OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "3", "--trainer.limit_train_batches", "2",
    "--trainer.limit_val_batches", "1", "--data.init_args.batch_size", "1",
    "--data.init_args.train_patches", "80", "--data.init_args.workers", "0",
)  # fmt: skip
SPACE = """
model.net.layers: {choice: [2, 3]}
model.optimizer.init_args.lr: {loguniform: [0.00001, 0.02]}
"""


def test_search_tells_trials_front_and_best_configuration(submitting):
    place, submit = submitting("tuned")
    (place.folder / "space.yaml").write_text(SPACE)
    printed = place.trainer(
        "tune", *submit[1:3], *OPTIONS, "--space", "space.yaml", "--trials", "3", "--grace", "1"
    )
    (folder,) = place.folder.glob("runs/tune/*")
    found = json.loads((folder / "trials.json").read_text())["trials"]
    assert len(found) == 3
    assert {trial["state"] for trial in found} <= {"finished", "stopped"}
    assert all(trial["cost"] > 0 and trial["values"]["model.net.layers"] in (2, 3) for trial in found)
    assert any(trial["best"] for trial in found)
    assert (folder / "trials.txt").read_text() in printed
    assert "Traceback" not in printed

    best = yaml.safe_load((folder / "best.yaml").read_text())
    values = next(trial["values"] for trial in found if trial["best"])
    assert best["model"]["init_args"]["net"]["init_args"]["layers"] == values["model.net.layers"]

    client = open_client(f"sqlite:///{place.folder / 'runs' / 'mlflow.db'}")
    runs = client.search_runs([e.experiment_id for e in client.search_experiments()])
    (parent,) = [run for run in runs if "mlflow.parentRunId" not in run.data.tags]
    children = [run for run in runs if run.data.tags.get("mlflow.parentRunId") == parent.info.run_id]
    assert len(children) == 3
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert {file.path for file in client.list_artifacts(parent.info.run_id)} >= {"pareto.png", "best.yaml"}

    again = place.trainer("tune", *submit[1:3], "--resume", str(folder))
    assert (folder / "trials.txt").read_text() in again
    assert len(json.loads((folder / "trials.json").read_text())["trials"]) == 3


def test_trials_of_two_processes_each_use_the_cluster_in_turn(submitting):
    """The cluster has as many cores as one trial takes: nothing beside its processes may reserve any."""
    place, submit = submitting("groups")
    (place.folder / "space.yaml").write_text(SPACE)
    printed = place.trainer(
        "tune", *submit[1:], *OPTIONS, "--space", "space.yaml", "--trials", "2", "--no-early-stop"
    )
    (results,) = place.folder.glob("runs/tune/*/trials.json")
    found = json.loads(results.read_text())["trials"]
    assert [(trial["state"], trial["epoch"]) for trial in found] == [("finished", 3)] * 2
    told = [word for line in printed.splitlines() for word in ("starts:", "finished") if f" {word}" in line]
    assert told[:4] == ["starts:", "finished"] * 2
