"""Runs arrive whole in their tracking store, whatever the store does meanwhile."""

import errno
import json
import os
import shutil
import threading
import time
import uuid
from types import SimpleNamespace

import pytest
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image

from trainer.runs import RunRecord, new_folder
from trainer.spool import machine, store
from trainer.spool.journal import events
from trainer.spool.machine import Sampler
from trainer.spool.sent import Sent
from trainer.tracking import MLflowTracking, open_client, tracking_uri

pytestmark = pytest.mark.usefixtures("workplace", "quick_sending")


def logger(uri=None, **options):
    return MLflowTracking(f"exp-{uuid.uuid4().hex[:8]}", uri, **{"system_metrics": False} | options)


def continued(first, **options):
    options = {"system_metrics": False, "resume_from": str(first.folder)} | options
    return MLflowTracking(first.experiment_name, **options)


def killed(log):
    """End the threads of a run as SIGKILL does: nothing more is recorded or sent."""
    log._sender.stop()
    log._sender.join()
    return log


def history(log, key):
    found = open_client(log.uri).get_metric_history(log.run_id, key)
    return [(metric.step, metric.value) for metric in found]


def files(log, folder=None):
    return [file.path for file in open_client(log.uri).list_artifacts(log.run_id, folder)]


def stored(log):
    return open_client(log.uri).get_run(log.run_id)


def rejected(log):
    return (log.folder / "spool" / "rejected.jsonl").read_text().splitlines()


def record_all(log):
    log.log_metrics({"loss": 1.0}, step=0)
    log.log_params({"lr": 0.1})
    log.set_tags({"note": "x"})
    log.log_text("seed: 1\n", "config.yaml")
    log.log_picture(Image.new("RGB", (40, 30)), "validation/a-0", 0)
    log.log_metrics({"loss": 0.5}, step=1)


def assert_complete(log, status="FINISHED"):
    run = stored(log)
    assert history(log, "loss") == [(0, 1.0), (1, 0.5)]
    assert run.data.params == {"lr": "0.1"}
    assert (run.data.tags["note"], run.info.status) == ("x", status)
    assert files(log) == ["config.yaml", "images"]
    assert [name.rsplit(".", 1)[1] for name in files(log, "images")] == ["webp", "png"]
    runs = open_client(log.uri).search_runs([run.info.experiment_id])
    assert [found.info.run_id for found in runs] == [log.run_id]


def test_local_store_needs_no_server_and_holds_everything_at_the_end(workplace):
    log = logger()
    record_all(log)
    log.finalize("success")
    assert_complete(log)
    artifacts = workplace / "runs" / "artifacts" / log.experiment_name / log.run_id / "artifacts"
    assert (artifacts / "config.yaml").is_file()


def test_local_store_is_made_on_a_file_system_without_links(tmp_path, monkeypatch, empty_store):
    def no_links(source, target):
        raise OSError(errno.EPERM, "no links")

    class Store:
        """Makes a database as MLflow does, at once."""

        engine = SimpleNamespace(dispose=lambda: None)

        def __init__(self, uri, artifacts):
            shutil.copy(empty_store, uri.removeprefix("sqlite:///"))

    monkeypatch.setattr("mlflow.store.tracking.sqlalchemy_store.SqlAlchemyStore", Store)
    monkeypatch.setattr(os, "link", no_links)
    store._make_database(tmp_path / "new.db")
    assert (tmp_path / "new.db").read_bytes() == empty_store.read_bytes()
    (tmp_path / "new.db").write_bytes(b"of another run that was faster")
    store._make_database(tmp_path / "new.db")
    assert (tmp_path / "new.db").read_bytes() == b"of another run that was faster"
    assert not list(tmp_path.glob(".new.db*"))


def test_run_folder_and_record_are_there_before_any_server_answers(proxy):
    log = logger(proxy.uri)
    log.log_metrics({"loss": 1.0}, step=0)
    assert RunRecord.load(log.folder).tracking_uri == proxy.uri
    assert log.run_id == ""
    killed(log)


def test_resumed_logger_continues_the_same_run_and_says_what_changed():
    first = logger()
    first.log_params({"lr": 0.001})
    first.log_metrics({"loss": 2.0}, step=1)
    first.finalize("failed")
    again = continued(first)
    assert again.log_params({"lr": 0.1, "new": 1}) == {"lr": ("0.001", "0.1")}
    again.log_metrics({"loss": 1.0}, step=2)
    again.finalize("success")
    assert again.run_id == first.run_id
    assert stored(again).data.params == {"lr": "0.001", "new": "1"}
    assert stored(again).info.status == "FINISHED"
    assert history(again, "loss") == [(1, 2.0), (2, 1.0)]


def test_steps_that_are_trained_again_after_a_kill_are_recorded_once():
    first = logger()
    for step in range(5):
        first.log_metrics({"loss": float(step), "epoch": 0}, step=step)
    killed(first)
    again = continued(first)
    for step in range(3, 8):
        again.log_metrics({"loss": float(step), "epoch": 0}, step=step)
    again.finalize("success")
    for key in ("loss", "epoch"):
        assert [step for step, _ in history(again, key)] == list(range(8))


def test_number_is_recorded_once_when_it_is_logged_twice_at_a_step():
    log = logger()
    log.log_metrics({"epoch": 0, "loss": 1.0}, step=3)
    log.log_metrics({"epoch": 0, "val": 2.0}, step=3)
    log.finalize("success")
    assert history(log, "epoch") == [(3, 0.0)]


@pytest.mark.parametrize("end", ["success", "failed"])
@pytest.mark.parametrize("status", ["FINISHED", "FAILED"])
def test_evaluation_adds_scores_and_keeps_the_status_of_the_training(status, end):
    training = logger()
    training.log_metrics({"loss": 2.0}, step=1)
    training.finalize("success" if status == "FINISHED" else "failed")
    before = stored(training).info
    test = continued(training, evaluation=True)
    test.log_metrics({"test/psnr": 30.0}, step=1)
    test.finalize(end)
    run = stored(test)
    assert run.data.metrics["test/psnr"] == 30.0
    assert (run.info.status, run.info.end_time) == (status, before.end_time)


def test_repeated_evaluation_records_only_what_differs():
    training = logger()
    training.log_metrics({"loss": 2.0}, step=1)
    training.finalize("success")
    for score in (30.0, 30.0, 31.0):
        test = continued(training, evaluation=True)
        test.log_metrics({"test/psnr": score}, step=1)
        test.finalize("success")
    assert sorted(value for _, value in history(training, "test/psnr")) == [30.0, 31.0]


def test_evaluation_of_an_old_run_that_is_gone_ends_the_new_one_with_its_own_status(workplace, capsys):
    folder = new_folder(workplace / "runs", "old")
    RunRecord("old", folder.name, tracking_uri(None), "0" * 32).save(folder)
    test = MLflowTracking("old", system_metrics=False, resume_from=str(folder), evaluation=True)
    test.log_metrics({"test/psnr": 30.0}, step=1)
    test.finalize("failed")
    assert "is no longer in" in capsys.readouterr().err
    assert stored(test).info.status == "FAILED"


def test_old_run_without_a_journal_is_continued_and_keeps_its_first_parameters(workplace, capsys):
    uri = tracking_uri(None)
    client = open_client(uri)
    run = client.create_run(client.create_experiment("old"), run_name="r").info.run_id
    client.log_param(run, "lr", "0.1")
    folder = new_folder(workplace / "runs", "old")
    RunRecord("old", folder.name, uri, run, "http://127.0.0.1:9", None).save(folder)
    log = MLflowTracking("old", system_metrics=False, resume_from=str(folder))
    log.log_params({"lr": 0.2, "width": 3})
    log.finalize("success")
    found = client.get_run(run)
    assert found.data.params == {"lr": "0.1", "width": "3"}
    assert found.info.status == "FINISHED"
    assert "lr: 0.1 → 0.2" in capsys.readouterr().err
    assert "lr: 0.1 → 0.2" in found.data.tags["params.changed"]


def test_numbers_that_are_not_finite_arrive():
    log = logger()
    log.log_metrics({"nan": float("nan"), "up": float("inf"), "down": float("-inf")}, step=0)
    log.finalize("success")
    metrics = stored(log).data.metrics
    assert metrics["nan"] != metrics["nan"]
    assert metrics["up"] > 1e308
    assert metrics["down"] < -1e308


def test_very_long_values_are_cut_and_arrive(proxy):
    proxy.start()
    log = logger(proxy.uri)
    log.log_params({"long": "é" * 20_000})
    log.set_tags({"long": "é" * 20_000})
    log.finalize("success")
    data = stored(log).data
    assert len(data.params["long"]) == 6000
    assert len(data.tags["long"]) == 8000
    assert data.tags["long"].endswith("…")


def test_entry_that_the_server_refuses_is_put_aside_and_the_rest_arrives(proxy, capsys):
    proxy.start()
    log = logger(proxy.uri)
    log.log_metrics({"bad//name": 1.0} | {f"m{n}": float(n) for n in range(9)}, step=0)
    log.set_tags({"after": "yes"})
    log.finalize("success")
    run = stored(log)
    assert len(run.data.metrics) == 9
    assert (run.data.tags["after"], run.info.status) == ("yes", "FINISHED")
    refused = [json.loads(line) for line in rejected(log)]
    assert [entry["event"]["values"] for entry in refused] == [{"bad//name": 1.0}]
    assert "bad//name" in capsys.readouterr().err


@pytest.mark.parametrize("damage", ["missing", "torn"])
def test_picture_that_was_lost_with_the_power_does_not_keep_back_what_comes_after(proxy, damage):
    log = logger(proxy.uri)
    log.log_picture(Image.new("RGB", (8, 8)), key="validation/a", step=1)
    log.log_metrics({"loss": 1.0}, step=1)
    (path,) = [p for p in (log.folder / "spool" / "files").rglob("*") if p.is_file()]
    path.unlink()
    if damage == "torn":
        path.write_bytes(b"")
    proxy.start()
    log.finalize("success")
    assert history(log, "loss") == [(1, 1.0)]
    assert stored(log).info.status == "FINISHED"
    (refused,) = rejected(log)
    assert path.name in refused


def test_server_that_is_away_at_the_start_gets_everything_when_it_comes(proxy, capsys):
    log = logger(proxy.uri)
    record_all(log)
    assert log.flush(5.0) > 0
    proxy.start()
    log.finalize("success")
    assert_complete(log)
    said = capsys.readouterr().err
    assert said.count("cannot be used (connection refused)") == 1
    assert said.count("answers again after") == 1
    assert f"trainer sync {log.folder}" in said


def test_server_that_is_away_for_the_whole_run_leaves_all_in_the_journal_for_the_continued_run(proxy, capsys):
    log = logger(proxy.uri)
    record_all(log)
    log.finalize("success")
    said = capsys.readouterr().err
    assert f"`trainer sync {log.folder}` sends them" in said
    proxy.start()
    again = continued(log)
    again.log_params({"lr": 0.1})
    again.finalize("success")
    assert_complete(again)


@pytest.mark.parametrize("status", [500, 502, 503, 404, 400])
def test_answers_that_are_not_mlflows_lose_nothing(proxy, status, capsys):
    proxy.start()
    log = logger(proxy.uri)
    log.log_metrics({"loss": 1.0}, step=0)
    assert log.flush(5.0) == 0
    proxy.status = status
    record_all(log)
    assert log.flush(5.0) > 0
    proxy.status = None
    log.finalize("success")
    assert_complete(log)
    assert f"HTTP status {status}" in capsys.readouterr().err
    assert not (log.folder / "spool" / "rejected.jsonl").exists()


@pytest.mark.parametrize("status", [401, 403])
def test_refused_credentials_are_named_and_nothing_is_lost(proxy, status, capsys):
    proxy.status = status
    proxy.start()
    log = logger(proxy.uri)
    record_all(log)
    assert log.flush(5.0) > 0
    proxy.status = None
    log.finalize("success")
    assert_complete(log)
    said = capsys.readouterr().err
    assert said.count("MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD, or MLFLOW_TRACKING_TOKEN") == 1


def test_files_that_the_server_cannot_keep_at_present_are_sent_later(proxy):
    proxy.start()
    proxy.status, proxy.refuse = 500, "mlflow-artifacts"
    log = logger(proxy.uri)
    record_all(log)
    assert log.flush(5.0) > 0
    proxy.status = None
    log.finalize("success")
    assert_complete(log)


def test_slow_server_is_asked_rarely_and_gets_everything(proxy):
    proxy.start()
    proxy.delay_s = 0.2
    log = logger(proxy.uri)
    for step in range(300):
        log.log_metrics({"loss": 1.0, "rate": 2.0}, step=step)
    log.finalize("success")
    assert [step for step, _ in history(log, "loss")] == list(range(300))
    assert sum("log-batch" in request for request in proxy.log) <= 20


def test_server_that_restarts_again_and_again_gets_every_number_once(proxy):
    log = logger(proxy.uri)
    for step in range(60):
        if step % 10 == 0:
            (proxy.start if step % 20 == 0 else proxy.stop)()
            log.flush(0.5)
        log.log_metrics({"loss": float(step)}, step=step)
    proxy.start()
    log.finalize("success")
    assert [step for step, _ in history(log, "loss")] == list(range(60))


@pytest.mark.parametrize("store", ["server", "local"])
def test_run_that_is_deleted_in_the_middle_is_replaced_by_one_with_everything(proxy, store, capsys):
    proxy.start()
    log = logger(proxy.uri if store == "server" else None)
    record_all(log)
    assert log.flush(30.0) == 0
    deleted = log.run_id
    open_client(log.uri).delete_run(deleted)
    log.finalize("success")
    assert log.run_id != deleted
    assert_complete(log)
    assert capsys.readouterr().err.count("is no longer in") == 1


def test_run_that_is_deleted_before_it_is_continued_is_replaced_by_one_with_everything():
    first = logger()
    record_all(first)
    first.finalize("failed")
    open_client(first.uri).delete_run(first.run_id)
    again = continued(first)
    again.log_params({"lr": 0.1})
    again.finalize("success")
    assert_complete(again)


def test_run_that_was_made_but_not_noted_before_a_kill_is_found_again():
    first = logger()
    record_all(first)
    assert first.flush(30.0) == 0
    made = first.run_id
    killed(first)
    record = first.record
    record.run_id = None
    record.save(first.folder)
    (first.folder / "spool" / "sent.json").unlink()
    again = continued(first)
    again.log_params({"lr": 0.1})
    again.finalize("success")
    assert again.run_id == made
    assert_complete(again)


def test_everything_can_be_sent_twice(proxy):
    proxy.start()
    log = logger(proxy.uri)
    record_all(log)
    log.log_metrics({"nan": float("nan"), "inf": float("inf")}, step=1)
    assert log.flush(30.0) == 0
    killed(log)
    Sent(log.run_id).save(log.folder)
    again = continued(log)
    again.log_params({"lr": 0.1})
    again.finalize("success")
    assert_complete(again)
    assert len(history(again, "nan")) == len(history(again, "inf")) == 1


def test_clock_that_is_set_back_or_forth_never_turns_the_order(monkeypatch):
    log = logger()
    log.log_metrics({"loss": 1.0}, step=0)
    monkeypatch.setattr(time, "time", lambda: 1e9)
    log.log_metrics({"loss": 0.9}, step=1)
    killed(log)
    again = continued(log)
    again.log_metrics({"loss": 0.8}, step=2)
    again.finalize("success")
    times = [event["t"] for event, _ in events(log.folder)]
    assert times == sorted(times)
    assert times[-1] - times[0] < 1e6
    found = open_client(again.uri).get_metric_history(again.run_id, "loss")
    assert [m.step for m in sorted(found, key=lambda m: m.timestamp)] == [0, 1, 2]


def test_machine_is_sampled_into_the_journal_and_its_steps_go_on_after_a_kill(monkeypatch):
    monkeypatch.setattr(machine, "INTERVAL_S", 0.05)
    key = "system/system_memory_usage_percentage"
    log = logger(system_metrics=True)
    log.log_metrics({"loss": 1.0}, step=0)
    wait_for_samples(log, key, 2)
    log._sampler.stop()
    killed(log)
    again = continued(log, system_metrics=True)
    again.log_metrics({"loss": 1.0}, step=1)
    wait_for_samples(log, key, 4)
    again.finalize("success")
    steps = [step for step, _ in history(again, key)]
    assert steps == list(range(len(steps)))


def wait_for_samples(log, key, count):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        samples = [event for event, _ in events(log.folder) if key in event.get("values", {})]
        if len(samples) >= count:
            return
        time.sleep(0.02)
    raise AssertionError("the machine is not sampled")


def test_sampler_stops_without_waiting_for_the_next_sample(monkeypatch):
    monkeypatch.setattr(machine, "INTERVAL_S", 3600.0)
    sampler = Sampler(lambda numbers, step: None, 0)
    sampler.start()
    stopping = threading.Thread(target=sampler.stop, daemon=True)
    stopping.start()
    stopping.join(timeout=60)
    assert not stopping.is_alive()


def test_other_ranks_record_nothing(workplace, monkeypatch):
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    log = logger()
    record_all(log)
    log.log_file(workplace / "absent")
    log.before_checkpoint()
    log.finalize("success")
    assert [path.name for path in (workplace / "runs").iterdir()] == ["mlflow.db"]


def test_uri_of_the_environment_is_used_unless_one_is_given(monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://example.invalid:1")
    assert tracking_uri(None) == "http://example.invalid:1"
    assert tracking_uri("sqlite:///x") == "sqlite:///x"
