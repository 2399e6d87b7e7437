"""`trainer sync`, `trainer upload`, and the models that arrive with a run."""

import argparse
import os
import shutil
import subprocess
import sys
import time
import urllib.request

import pytest

from models import WSKP
from tests.tracking_server import free_port
from tests.trainer.test_tracking import (
    assert_complete,
    continued,
    files,
    history,
    killed,
    logger,
    record_all,
    stored,
)
from trainer.commands import sync, upload
from trainer.configs import UsageError
from trainer.export import export
from trainer.export.register import weights_of
from trainer.runs import RunRecord
from trainer.spool import journal, past
from trainer.spool.journal import Journal, events, journal_size
from trainer.spool.sender import Lock
from trainer.spool.sent import Backlog, Sent, left
from trainer.spool.store import unreachable
from trainer.tracking import MLflowTracking, open_client

pytestmark = pytest.mark.usefixtures("workplace", "quick_sending")


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    monkeypatch.setattr(sync.time, "sleep", lambda seconds: None)


def synced(*folders, every=False, unmirrored=False):
    parser = argparse.ArgumentParser()
    sync.add_arguments(parser)
    options = ["--all"] * every + ["--unmirrored"] * unmirrored
    return sync.run(parser.parse_args([*map(str, folders), *options]))


def uploaded(folder, to=None):
    return upload.run(argparse.Namespace(run=folder, to=to))


def unsent(uri):
    log = logger(uri)
    record_all(log)
    log.finalize("success")
    assert left(log.folder) > 0
    return log


def test_sync_sends_what_is_left_once_and_says_so(proxy, capsys):
    log = unsent(proxy.uri)
    assert synced(log.folder) == 1
    said = capsys.readouterr().out
    assert "events are left. The tracking server" in said
    assert "sent" not in said
    proxy.start()
    assert synced(log.folder) == 0
    said = capsys.readouterr().out
    assert "sent 2 metric values and 2 files to" in said
    assert_complete(log)
    assert synced(log.folder) == 0
    assert "nothing is left" in capsys.readouterr().out


def test_sync_keeps_from_the_store_what_a_mirror_lacks(proxy, capsys):
    log = logger(proxy.uri)
    log.deliver_up_to(0)
    log.log_metrics({"loss": 1.0}, step=0)
    log.deliver_up_to(journal_size(log.folder))
    log.log_metrics({"loss": 2.0}, step=1)
    killed(log)
    proxy.start()
    assert synced(log.folder) == 1
    said = capsys.readouterr().out
    assert "sent 1 metric values" in said
    assert "1 events are left. They were recorded after the run's last copy to its mirror" in said
    assert history(log, "loss") == [(0, 1.0)]
    assert synced(log.folder, unmirrored=True) == 0
    assert history(log, "loss") == [(0, 1.0), (1, 2.0)]


def test_run_that_goes_on_without_a_mirror_keeps_nothing_back(proxy):
    log = logger(proxy.uri)
    log.deliver_up_to(0)
    log.log_metrics({"loss": 1.0}, step=0)
    killed(log)
    again = continued(log)
    again.log_metrics({"loss": 2.0}, step=1)
    killed(again)
    proxy.start()
    assert synced(log.folder) == 0
    assert history(log, "loss") == [(0, 1.0), (1, 2.0)]


def test_sync_of_all_finds_the_runs_that_have_something_left(proxy, capsys):
    runs = [unsent(proxy.uri), unsent(proxy.uri)]
    whole = logger()
    whole.log_metrics({"loss": 1.0}, step=0)
    whole.finalize("success")
    proxy.start()
    assert synced(every=True) == 0
    said = capsys.readouterr().out
    assert all(str(log.folder) in said for log in runs)
    assert str(whole.folder) not in said
    for log in runs:
        assert_complete(log)
    assert synced(every=True) == 0
    assert "nothing is left to send below runs" in capsys.readouterr().out


def test_sync_of_all_sends_the_others_of_a_damaged_run(proxy, capsys):
    damaged, log = unsent(proxy.uri), unsent(proxy.uri)
    (damaged.folder / "run.json").write_text("{")
    proxy.start()
    assert synced(every=True) == 1
    assert "run.json is damaged" in capsys.readouterr().err
    assert_complete(log)


def test_lock_is_free_once_it_is_released_even_if_a_forked_process_lives_on(proxy):
    log = unsent(proxy.uri)
    lock = Lock(log.folder)
    assert lock.acquire()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(writing)
        os.read(reading, 1)  # until the test ends
        os._exit(0)
    try:
        lock.release()
        other = Lock(log.folder)
        assert other.acquire()
        other.release()
    finally:
        os.close(writing)
        os.waitpid(child, 0)


def test_backlog_is_counted_by_reading_every_line_once(tmp_path, monkeypatch):
    RunRecord("exp", "run", "sqlite:///x", "id").save(tmp_path)
    log, lines, parsed = Journal(tmp_path), [], journal.parsed
    monkeypatch.setattr(journal, "parsed", lambda line: lines.append(line) or parsed(line))
    backlog = Backlog(tmp_path)
    for step in range(4):
        log.append({"type": "metrics", "step": step, "values": {}})
    assert (backlog(), len(lines)) == (4, 4)
    ends = [offset for _, offset in events(tmp_path)]
    lines.clear()
    Sent("id", ends[1]).save(tmp_path)
    assert (backlog(), lines) == (2, [])
    log.append({"type": "metrics", "step": 4, "values": {}})
    assert (backlog(), len(lines)) == (3, 1)
    Sent("id", journal.journal_size(tmp_path)).save(tmp_path)
    assert (backlog(), len(lines)) == (0, 1)


def test_sync_of_nothing_asks_for_runs_and_of_another_folder_says_that_it_is_none(workplace):
    with pytest.raises(UsageError, match="--all"):
        synced()
    with pytest.raises(ValueError, match=r"is not a run folder"):
        synced(workplace)


def test_sync_names_refused_credentials(proxy, capsys):
    log = unsent(proxy.uri)
    proxy.status = 401
    proxy.start()
    assert synced(log.folder) == 1
    assert "MLFLOW_TRACKING_USERNAME" in capsys.readouterr().out


def test_sync_leaves_a_run_alone_that_another_process_sends(proxy, capsys):
    log = unsent(proxy.uri)
    lock = Lock(log.folder)
    assert lock.acquire()
    proxy.start()
    assert synced(log.folder) == 1
    assert "another process" in capsys.readouterr().out
    assert proxy.log == []
    lock.release()
    assert synced(log.folder) == 0


def test_run_that_is_sent_elsewhere_is_trained_on_and_waits_for_its_turn(proxy):
    log = unsent(proxy.uri)
    lock = Lock(log.folder)
    assert lock.acquire()
    again = continued(log)
    again.log_metrics({"loss": 0.2}, step=2)
    proxy.start()
    assert again.flush(0.5) > 0
    lock.release()
    again.finalize("success")
    assert [step for step, _ in history(again, "loss")] == [0, 1, 2]


def test_upload_moves_a_local_run_to_the_server_with_everything(proxy, capsys):
    log = logger()
    record_all(log)
    log.finalize("success")
    proxy.start()
    assert uploaded(log.folder, proxy.uri) == 0
    assert RunRecord.load(log.folder).tracking_uri == proxy.uri
    assert_complete(log)
    capsys.readouterr()
    assert uploaded(log.folder, proxy.uri) == 0
    assert "is tracked by" in capsys.readouterr().out


def old_run():
    """A run as it was left before there were journals: its local store holds everything."""
    log = logger()
    record_all(log)
    log.finalize("success")
    shutil.rmtree(log.folder / "spool")
    return log


def test_upload_of_a_run_from_before_the_journal_sends_what_its_store_holds(proxy):
    log = old_run()
    record = log.record
    # as it was left by a version that went on with the local store when a server broke away
    server = open_client(proxy.start().uri)
    begun = server.create_run(server.create_experiment(record.experiment), run_name=record.name).info.run_id
    record.unreached_uri, record.server_run_id = proxy.uri, begun
    record.save(log.folder)
    assert uploaded(log.folder) == 0
    assert log.run_id == begun
    assert_complete(log)


class KilledError(BaseException):
    """Stands in for SIGKILL."""


@pytest.mark.parametrize("moment", ["_write_metrics", "_write_artifacts", "_write_models", "save"])
def test_upload_of_a_run_from_before_the_journal_can_be_repeated_after_a_kill(proxy, monkeypatch, moment):
    def killed_here(*arguments):
        raise KilledError

    log = old_run()
    proxy.start()
    with monkeypatch.context() as patch:
        patch.setattr(RunRecord if moment == "save" else past, moment, killed_here)
        with pytest.raises(KilledError):
            uploaded(log.folder, proxy.uri)
    assert log.uri.startswith("sqlite:")
    assert uploaded(log.folder, proxy.uri) == 0
    assert_complete(log)


def test_upload_of_a_continued_run_from_before_the_journal_keeps_its_beginning(proxy):
    old = old_run()
    log = continued(old)
    log.log_metrics({"loss": 0.2}, step=2)
    log.log_params({"lr": 0.1})
    log.log_text("seed: 2\n", "config-resumed-1.yaml")
    log.finalize("failed")
    proxy.start()
    assert uploaded(log.folder, proxy.uri) == 0
    run = stored(log)
    assert history(log, "loss") == [(0, 1.0), (1, 0.5), (2, 0.2)]
    assert (run.data.params, run.data.tags["note"], run.info.status) == ({"lr": "0.1"}, "x", "FAILED")
    assert files(log) == ["config-resumed-1.yaml", "config.yaml", "images"]
    assert not (log.folder / "spool" / "rejected.jsonl").exists()


def test_upload_of_an_evaluated_run_from_before_the_journal_keeps_the_status_of_its_training(proxy):
    log = continued(old_run(), evaluation=True)
    log.log_metrics({"test/psnr": 30.0}, step=1)
    log.finalize("failed")
    proxy.start()
    assert uploaded(log.folder, proxy.uri) == 0
    assert stored(log).data.metrics["test/psnr"] == 30.0
    assert_complete(log)


def test_upload_of_an_old_run_whose_store_is_gone_says_so_and_changes_nothing(proxy):
    log = old_run()
    record = log.record
    record.run_id = "0" * 32
    record.save(log.folder)
    proxy.start()
    with pytest.raises(ValueError, match=r"cannot be read from the tracking store .* nothing was sent"):
        uploaded(log.folder, proxy.uri)
    assert RunRecord.load(log.folder) == record


def test_upload_to_an_unreachable_server_fails_and_changes_nothing():
    log = logger()
    log.log_metrics({"loss": 1.0}, step=0)
    log.finalize("success")
    before = (log.folder / "run.json").read_text()
    with pytest.raises(ValueError, match=r"cannot be reached .* nothing was sent"):
        uploaded(log.folder, f"http://127.0.0.1:{free_port()}")
    assert (log.folder / "run.json").read_text() == before


def test_upload_without_a_server_asks_for_one():
    log = logger()
    log.log_metrics({"loss": 1.0}, step=0)
    log.finalize("success")
    with pytest.raises(ValueError, match="--to URI"):
        uploaded(log.folder)


def test_upload_of_a_run_that_is_being_trained_is_refused(proxy):
    log = logger()
    log.log_metrics({"loss": 1.0}, step=0)
    log.flush()
    with pytest.raises(ValueError, match=r"another process sends .*: its training"):
        uploaded(log.folder, proxy.start().uri)
    killed(log)


def test_server_behind_a_proxy_that_guards_or_hides_the_health_path_counts_as_reachable(proxy):
    proxy.start()
    for status in (200, 401, 403, 404):
        proxy.status = status
        assert unreachable(proxy.uri) is None, status
    for status in (500, 502, 503):
        proxy.status = status
        assert unreachable(proxy.uri) == f"HTTP status {status}"


def test_model_is_registered_once_for_the_same_weights_whatever_breaks_away(workplace, proxy, capsys):
    net = WSKP(layers=3).eval()
    path = workplace / "wskp.onnx"
    export(net, path, "onnx")
    proxy.start()
    proxy.status, proxy.refuse = 503, "model-versions/create"
    log = logger(proxy.uri)
    name = f"model-{log.experiment_name}"
    log.log_model(path, name, weights_of(net))
    log.log_model(path, name, weights_of(net))
    assert log.flush(10.0) == 1
    proxy.status = None
    log.finalize("success")
    Sent(log.run_id).save(log.folder)
    assert synced(log.folder) == 0
    client = open_client(log.uri)
    versions = client.search_model_versions(f"name = '{name}'")
    assert [(v.version, v.run_id, v.status) for v in versions] == [("1", log.run_id, "READY")]
    models = client.search_logged_models([stored(log).info.experiment_id])
    assert [f"models:/{model.model_id}" for model in models] == [versions[0].source]
    assert capsys.readouterr().err.count(f"registered models:/{name}/1") == 1


@pytest.fixture
def server(tmp_path):
    """A real `mlflow server` on loopback: its URI, and functions that start and kill it."""
    port = free_port()
    uri, folder = f"http://127.0.0.1:{port}", tmp_path / "server"
    folder.mkdir()
    command = [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{folder}/db",
        "--artifacts-destination", str(folder / "artifacts"), "--host", "127.0.0.1", "--port", str(port),
        "--workers", "1",
    ]  # fmt: skip
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    running = []

    def start():
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        running.append(subprocess.Popen(command, env=environment, start_new_session=True, **quiet))
        deadline = time.monotonic() + 240
        while time.monotonic() < deadline:
            try:
                urllib.request.urlopen(f"{uri}/health", timeout=1).close()
                return
            except OSError:
                running[-1].poll()
        raise AssertionError("the tracking server did not start")

    def stop():
        process = running.pop()
        os.killpg(process.pid, 9)  # the server and its own workers: the group that was started above
        process.wait()

    yield uri, start, stop
    while running:
        stop()


@pytest.mark.slow
def test_mlflow_server_that_is_killed_in_mid_run_ends_with_everything_in_one_run(server):
    uri, start, stop = server
    start()
    log = MLflowTracking("exp", tracking_uri=uri, system_metrics=False)
    log.log_metrics({"loss": 3.0}, step=0)
    log.log_params({"lr": 0.001})
    assert log.flush(60.0) == 0
    run = log.run_id
    stop()
    log.log_metrics({"loss": 2.0}, step=1)
    log.log_text("text", "note.txt")
    log.log_params({"lr": 0.001, "width": 14})
    log.finalize("success")
    start()
    assert synced(log.folder) == 0
    assert log.run_id == run
    assert history(log, "loss") == [(0, 3.0), (1, 2.0)]
    assert stored(log).data.params == {"lr": "0.001", "width": "14"}
    assert stored(log).info.status == "FINISHED"
    assert [file.path for file in open_client(uri).list_artifacts(run)] == ["note.txt"]
