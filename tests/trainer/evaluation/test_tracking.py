"""An evaluation in a tracking store: runs, links, files; and the runs that trained what was compared."""

import json
import sys

import pandas as pd
import pytest
from PIL import Image

from tests.trainer.evaluation.test_evaluate import HERE, frames  # noqa: F401  # a fixture
from tests.trainer.evaluation.test_tables import rows
from trainer.cli import main
from trainer.evaluation.keeping import take_folder
from trainer.evaluation.plan import Method
from trainer.evaluation.running import Outcome
from trainer.evaluation.tracking import page_of, track, training_run, training_url
from trainer.runs import RunRecord
from trainer.spool.store import open_client


@pytest.fixture
def evaluated(monkeypatch, frames, tmp_path):  # noqa: F811  # the fixture
    """A folder with an evaluation of two methods, one of which fails, and the store that has it."""
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.chdir(tmp_path)
    command = ["trainer", "evaluate", "--data", str(frames), "--output", "out", "--no-costs"]
    models = ["--model", f"half={HERE}.Halved", "--model", f"greedy={HERE}.Greedy", "--metric", "psnr_wskp"]
    monkeypatch.setattr(sys, "argv", [*command, *models])
    assert main() == 0
    return tmp_path / "out", open_client(uri)


def runs_of(client):
    return client.search_runs([client.get_experiment_by_name("evaluations").experiment_id])


def test_methods_are_below_the_run_of_the_evaluation_with_scores_and_reasons(evaluated):
    folder, client = evaluated
    runs = {run.info.run_name: run for run in runs_of(client)}
    assert set(runs) == {"out", "input", "half", "greedy"}
    parent = runs.pop("out")
    assert (parent.data.params["frames"], parent.data.params["scenes"]) == ("3", "room")
    assert "| half |" in parent.data.tags["mlflow.note.content"]
    assert {run.data.tags["mlflow.parentRunId"] for run in runs.values()} == {parent.info.run_id}
    assert {name: run.info.status for name, run in runs.items()} == {
        "input": "FINISHED", "half": "FINISHED", "greedy": "FAILED",
    }  # fmt: skip
    assert "specular" in runs["greedy"].data.tags["penumbra.reason"]
    rows = pd.read_parquet(folder / "rows.parquet")
    mean = rows[rows["method"] == "half"]["psnr_wskp"].mean()
    assert runs["half"].data.metrics["psnr_wskp"] == pytest.approx(mean)


def test_page_tables_plots_and_pictures_are_in_the_store(evaluated):
    folder, client = evaluated
    (parent,) = [run for run in runs_of(client) if run.info.run_name == "out"]

    def files(path=None):
        return {file.path for file in client.list_artifacts(parent.info.run_id, path)}

    assert files() >= {"report.html", "rows.parquet", "evaluation.json", "tables", "plots", "pictures"}
    (picture,) = files("pictures")
    assert picture == "pictures/room.png"
    with Image.open(folder / picture) as sheet:
        width, height = sheet.size
    assert width > 2 * 256  # three panels of crops that are enlarged
    assert height > 2 * 192  # with error maps below
    assert files("plots") == {"plots/time_psnr_wskp.png", "plots/time_psnr_wskp.pdf"}


def test_an_evaluation_that_is_run_again_has_the_same_runs(evaluated):
    _, client = evaluated
    before = {run.info.run_id for run in runs_of(client)}
    assert main() == 0
    assert {run.info.run_id for run in runs_of(client)} == before


def outcome(label, model, status="done"):
    done = Outcome(Method(label, model, folder=label))
    done.facts = {"class": model}
    done.rows = {"s/f000": {"status": status, "reason": None if status == "done" else "it broke"}}
    return done


def tracked(folder, uri, *outcomes, value=20.0, scene="s"):
    take_folder(folder, "these", "frames")
    made = rows({(o.method.label, scene): [value] for o in outcomes})
    return track(folder, outcomes, made, ["psnr_wskp"], uri)


def test_a_method_that_is_another_now_has_another_run_and_old_numbers_are_gone(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    first = tracked(tmp_path / "out", uri, outcome("x", "Half"), outcome("y", "Third"))
    again = tracked(tmp_path / "out", uri, outcome("x", "Quarter"), value=8.0)
    runs = {run.info.run_name: run for run in runs_of(open_client(uri))}
    assert set(runs) == {"out", "x"}
    assert (runs["x"].data.params["model"], runs["x"].data.metrics["psnr_wskp"]) == ("Quarter", 8.0)
    assert first.runs["x"] != again.runs["x"]
    assert first.runs[""] == again.runs[""]


def test_two_evaluations_in_folders_of_one_name_have_runs_of_their_own(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    one = tracked(tmp_path / "out", uri, outcome("x", "Half"))
    (tmp_path / "out").rename(tmp_path / "elsewhere")  # as another container has it
    other = tracked(tmp_path / "out", uri, outcome("x", "Half"))
    assert not set(one.runs.values()) & set(other.runs.values())


def test_names_of_scenes_may_have_any_letters(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    run = tracked(tmp_path / "out", uri, outcome("x", "Half"), scene="Küche (v2), 50%").runs["x"]
    assert open_client(uri).get_run(run).data.metrics["psnr_wskp/Küche _v2__ 50_"] == 20.0


def test_a_store_that_cannot_be_used_is_told_and_loses_nothing(evaluated, monkeypatch, capsys):
    folder, _ = evaluated
    (folder / "report.html").unlink()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    assert main() == 0
    assert "note: not recorded in the tracking server http://127.0.0.1:9" in capsys.readouterr().err
    assert (folder / "report.html").is_file()
    assert json.loads((folder / "evaluation.json").read_text())["run_url"] is None


def test_pages_have_the_address_of_a_server_without_its_password():
    assert (
        page_of("http://user:word@host:5000/mlflow/", "3", "abc")
        == "http://host:5000/mlflow/#/experiments/3/runs/abc"
    )
    assert page_of("sqlite:///mlflow.db", "3", "abc") is None


def test_the_run_that_trained_a_model_is_found_by_its_checkpoint_its_folder_and_its_version(tmp_path):
    store = f"sqlite:///{tmp_path / 'mlflow.db'}"
    folder = tmp_path / "runs" / "exp" / "one"
    checkpoint = folder / "checkpoints" / "best.ckpt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"")
    RunRecord("exp", "one", "http://host:5000", "abc").save(folder)
    assert (
        training_run(str(checkpoint), store)
        == training_run(str(folder), store)
        == ("http://host:5000", "abc")
    )
    assert training_run("runs:/def/export/x.onnx", store) == (store, "def")
    client = open_client(store)
    run = client.create_run(client.create_experiment("e")).info.run_id
    client.create_registered_model("wskp")
    client.create_model_version("wskp", "file:///x", run)
    client.set_registered_model_alias("wskp", "champion", "1")
    for name in ("models:/wskp/1", "models:/wskp@champion", "models:/wskp/latest"):
        assert training_run(name, store) == (store, run)
    for unknown in (
        "models:/wskp/7",
        "models:/none@champion",
        "NFOR",
        str(tmp_path / "no.ckpt"),
        str(tmp_path),
    ):
        assert training_run(unknown, store) is None
    assert training_url("models:/wskp/1", store) is None  # no server, no page
