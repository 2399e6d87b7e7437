import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from trainer.commands import upload
from trainer.runs import RunRecord
from trainer.tracking import MLflowTracking, open_client, tracking_uri, unreachable


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture
def server(tmp_path):
    """A real tracking server on loopback; its URI, and functions that start and kill it."""
    port = free_port()
    uri = f"http://127.0.0.1:{port}"
    folder = tmp_path / "server"
    folder.mkdir()
    command = [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{folder}/db",
        "--artifacts-destination", str(folder / "artifacts"), "--host", "127.0.0.1", "--port", str(port),
        "--workers", "1",
    ]  # fmt: skip
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}

    def start():
        process = subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        for _ in range(240):
            try:
                urllib.request.urlopen(f"{uri}/health", timeout=1).close()
                return process
            except OSError:
                time.sleep(0.5)
        raise AssertionError("the tracking server did not start")

    def stop(process):
        os.killpg(process.pid, 9)  # the server and its own workers: the group that was started above
        process.wait()

    return uri, start, stop


def arguments(folder, to=None):
    import argparse

    return argparse.Namespace(run=folder, to=to)


def test_local_store_needs_no_server_and_holds_everything(tmp_path):
    logger = MLflowTracking("exp", system_metrics=False)
    logger.log_metrics({"train/loss": 0.5}, step=3)
    logger.log_params({"model.layers": 6})
    logger.log_text("seed: 1\n", "config.yaml")
    logger.finalize("success")
    run = open_client(logger.uri).get_run(logger.run_id)
    assert run.data.metrics == {"train/loss": 0.5}
    assert run.data.params == {"model.layers": "6"}
    assert run.info.status == "FINISHED"
    assert (tmp_path / "runs" / "mlflow.db").is_file()
    assert (tmp_path / "runs" / "artifacts" / "exp" / logger.run_id / "artifacts" / "config.yaml").is_file()


def test_resumed_logger_continues_the_same_run_and_keeps_its_parameters():
    first = MLflowTracking("exp", system_metrics=False)
    first.log_params({"lr": 0.001})
    first.log_metrics({"loss": 2.0}, step=1)
    again = MLflowTracking("exp", system_metrics=False, resume_from=str(first.folder))
    again.log_params({"lr": 0.1, "new": 1})
    again.log_metrics({"loss": 1.0}, step=2)
    again.finalize("success")
    run = open_client(first.uri).get_run(first.run_id)
    assert again.run_id == first.run_id
    assert run.data.params == {"lr": "0.001", "new": "1"}
    assert [m.step for m in open_client(first.uri).get_metric_history(first.run_id, "loss")] == [1, 2]


@pytest.mark.parametrize("end", ["success", "failed"])
@pytest.mark.parametrize("status", ["FINISHED", "FAILED"])
def test_evaluation_adds_scores_and_keeps_the_status_of_the_training(status, end):
    training = MLflowTracking("exp", system_metrics=False)
    training.log_metrics({"loss": 2.0}, step=1)
    training.finalize("success" if status == "FINISHED" else "failed")
    before = open_client(training.uri).get_run(training.run_id).info
    test = MLflowTracking("exp", system_metrics=False, resume_from=str(training.folder), evaluation=True)
    test.log_metrics({"test/psnr": 30.0}, step=1)
    test.finalize(end)
    run = open_client(training.uri).get_run(training.run_id)
    assert run.data.metrics["test/psnr"] == 30.0
    assert (run.info.status, run.info.end_time) == (status, before.end_time)


def test_evaluation_whose_run_is_gone_ends_the_new_run_with_its_own_status(capsys):
    training = MLflowTracking("exp", system_metrics=False)
    record = training.record
    record.run_id = "0" * 32
    record.save(training.folder)
    test = MLflowTracking("exp", system_metrics=False, resume_from=str(training.folder), evaluation=True)
    test.log_metrics({"test/psnr": 30.0}, step=1)
    test.finalize("failed")
    assert "is no longer in its store" in capsys.readouterr().err
    assert open_client(test.uri).get_run(test.run_id).info.status == "FAILED"


def test_unreachable_server_falls_back_to_the_local_store_and_says_so_once(capsys):
    uri = f"http://127.0.0.1:{free_port()}"
    logger = MLflowTracking("exp", tracking_uri=uri, system_metrics=False)
    for step in range(3):
        logger.log_metrics({"loss": 1.0 / (step + 1)}, step=step)
    logger.finalize("success")
    message = capsys.readouterr().err
    assert message.count(uri) == 1
    assert f"trainer upload {logger.folder}" in message
    assert json.loads((logger.folder / "run.json").read_text())["unreached_uri"] == uri
    assert len(open_client(logger.uri).get_metric_history(logger.run_id, "loss")) == 3


def test_upload_to_an_unreachable_server_fails_and_changes_nothing():
    logger = MLflowTracking("exp", system_metrics=False)
    logger.log_metrics({"loss": 1.0}, step=0)
    before = (logger.folder / "run.json").read_text()
    with pytest.raises(ValueError, match=r"cannot be reached .* nothing was sent"):
        upload.run(arguments(logger.folder, to=f"http://127.0.0.1:{free_port()}"))
    assert (logger.folder / "run.json").read_text() == before


@pytest.fixture
def proxy():
    """A server on loopback that answers every request with one status; its URI, and the status to set."""
    answers = {"status": 200}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(answers["status"])
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format, *args):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield f"http://127.0.0.1:{http.server_port}", answers
        http.shutdown()
        thread.join()


def test_server_behind_a_proxy_that_guards_or_hides_the_health_path_counts_as_reachable(proxy):
    uri, answers = proxy
    for status in (200, 401, 403, 404):
        answers["status"] = status
        assert unreachable(uri) is None, status
    for status in (500, 502, 503):
        answers["status"] = status
        assert unreachable(uri) == f"HTTP status {status}"


def test_upload_without_a_server_asks_for_one():
    logger = MLflowTracking("exp", system_metrics=False)
    logger.log_metrics({"loss": 1.0}, step=0)
    with pytest.raises(ValueError, match="--to URI"):
        upload.run(arguments(logger.folder))


def test_uri_of_the_environment_is_used_unless_one_is_given(monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://example.invalid:1")
    assert tracking_uri(None) == "http://example.invalid:1"
    assert tracking_uri("sqlite:///x") == "sqlite:///x"


def test_server_lost_in_mid_run_loses_nothing_and_upload_completes_its_run(server, monkeypatch):
    uri, start, stop = server
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    process = start()
    try:
        logger = MLflowTracking("exp", tracking_uri=uri, system_metrics=False)
        logger.log_metrics({"loss": 3.0}, step=0)
        logger.log_params({"lr": 0.001})
        remote_id = logger.run_id
    finally:
        stop(process)
    logger.log_metrics({"loss": 2.0}, step=1)
    logger.log_text("text", "note.txt")
    logger.log_params({"lr": 0.001, "width": 14})
    logger.finalize("success")
    assert logger.uri.startswith("sqlite:///")
    process = start()
    try:
        assert upload.run(arguments(logger.folder)) == 0
        client = open_client(uri)
        run = client.get_run(remote_id)
        assert [(m.step, m.value) for m in client.get_metric_history(remote_id, "loss")] == [
            (0, 3.0),
            (1, 2.0),
        ]
        assert run.data.params == {"lr": "0.001", "width": "14"}
        assert run.info.status == "FINISHED"
        assert [f.path for f in client.list_artifacts(remote_id)] == ["note.txt"]
        record = RunRecord.load(logger.folder)
        assert (record.tracking_uri, record.run_id) == (uri, remote_id)
    finally:
        stop(process)
