"""Training, resuming, registering, denoising and serving through the servers of the compose file."""

import os
import signal
import subprocess
import urllib.error
import urllib.request
from base64 import b64encode
from pathlib import Path

import psutil
import pytest
import s3fs

from data.exr import read_frame
from data.sample import SAMPLES
from tests.end_to_end.conftest import Workplace, cache  # noqa: F401  # a fixture
from tests.end_to_end.test_resume import wait_for_step
from tests.stack.compose import ROOT
from trainer.runs import RunRecord
from trainer.serving.memory import PROCESS
from trainer.tracking import open_client

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

# Everything that a training does, in three short epochs.
OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--config", "often.yaml", "--trainer.max_epochs", "3",
    "--data.batch_size", "2",
    "--trainer.limit_train_batches", "7", "--trainer.limit_val_batches", "1",
)  # fmt: skip
OFTEN = """
trainer:
  log_every_n_steps: 1
  callbacks:
    - class_path: trainer.callbacks.TrainingProgress
    - class_path: trainer.callbacks.BestCheckpoint
    - class_path: trainer.callbacks.LastCheckpoint
      init_args: {every_n_train_steps: 2}
    - class_path: trainer.callbacks.FiniteGuard
    - class_path: trainer.callbacks.ValidationPictures
    - class_path: trainer.callbacks.ExportBest
"""
FRAME = SAMPLES["bmfr"] / "classroom" / "f000.exr"
SEARCH = "/api/2.0/mlflow/experiments/search?max_results=5"


@pytest.fixture(scope="module")
def place(stack, tmp_path_factory, cache):  # noqa: F811
    """An empty folder whose commands use the servers, with the environment of the service `trainer`."""
    place = Workplace(tmp_path_factory.mktemp("place"), cache)
    place.environment |= stack.environment | {"PENUMBRA_ALIVE": str(place.folder / "alive")}
    return place


@pytest.fixture(scope="module")
def run(place, stack):
    """A training that was killed in its first epoch and continued; its record."""
    (place.folder / "often.yaml").write_text(OFTEN)
    process = place.start("fit", *OPTIONS)
    step = wait_for_step(place, 4, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert step < 21, "the run ended before it was killed"
    place.trainer("fit", *OPTIONS, "--ckpt_path", "last")
    assert len(place.runs) == 1
    return RunRecord.load(place.runs[0])


@pytest.fixture(scope="module")
def client(stack):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in stack.environment.items():
            patch.setenv(name, value)
        yield open_client(stack.tracking_uri)


@pytest.fixture(scope="module")
def champion(run, client):
    """The registered version, named champion."""
    client.set_registered_model_alias("wskp", "champion", "1")
    return "models:/wskp@champion"


def status(stack, path, *, account=None, host=None, data=None):
    """Return the HTTP status of a request to the tracking server."""
    headers = {"Content-Type": "application/json"}
    if account:
        headers["Authorization"] = "Basic " + b64encode(":".join(account).encode()).decode()
    if host:
        headers["Host"] = host
    request = urllib.request.Request(stack.tracking_uri + path, data=data, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def trainer_account(stack):
    return stack.environment["MLFLOW_TRACKING_USERNAME"], stack.environment["MLFLOW_TRACKING_PASSWORD"]


def test_tracking_server_refuses_whoever_has_no_account(stack):
    assert status(stack, SEARCH) == 401
    assert status(stack, SEARCH, account=("trainer", "wrong")) == 401
    assert status(stack, SEARCH, account=trainer_account(stack)) == 200
    assert status(stack, "/health") == 200


def test_trainers_account_cannot_make_accounts(stack):
    data = b'{"username": "other", "password": "0123456789abcdef"}'
    account = trainer_account(stack)
    assert status(stack, "/api/2.0/mlflow/users/create", account=account, data=data) == 403


def test_server_answers_to_its_name_in_the_network_and_to_no_other(stack):
    account = trainer_account(stack)
    assert status(stack, SEARCH, account=account, host=f"tracking:{stack.ports['tracking']}") == 200
    assert status(stack, SEARCH, account=account, host="elsewhere.example") == 403


def test_store_refuses_whoever_has_no_key(stack):
    address = stack.environment["AWS_ENDPOINT_URL"]
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(f"{address}/{stack.artifact_bucket}", timeout=30)
    assert caught.value.code == 403
    caught.value.close()


def test_setting_up_again_changes_nothing(stack):
    printed = stack.run_service("set-up").splitlines()
    assert [line.rsplit(" ", 1)[1] for line in printed] == ["exists"] * 3


def test_killed_run_continues_in_its_mlflow_run_without_gap_or_duplicate(run, client, stack):
    assert run.tracking_uri == stack.tracking_uri
    experiment = client.get_experiment_by_name("wskp_bmfr")
    assert [found.info.run_id for found in client.search_runs([experiment.experiment_id])] == [run.run_id]
    assert client.get_run(run.run_id).info.status == "FINISHED"
    for name, expected in (("train/loss_step", range(21)), ("val/psnr_wskp", (6, 13, 20))):
        steps = sorted(entry.step for entry in client.get_metric_history(run.run_id, name))
        assert steps == list(expected), name


def test_health_check_of_the_trainer_sees_that_it_worked(run, place, stack):
    place_of_image = Path(stack.services["trainer"].health[1])
    assert place_of_image.name == "alive"
    (place.folder / "stat").write_text("1 (a) S " + "0 " * 20)  # as old as this machine
    done = subprocess.run(
        [ROOT / "docker" / "with-progress-of", place.folder / "alive"],
        env=place.environment | {"JOB_STAT": str(place.folder / "stat"), "STALL_MINUTES": "60"},
    )
    assert done.returncode == 0


def test_artifacts_lie_in_the_store_and_pass_through_the_server(run, client, stack, place):
    uri = client.get_run(run.run_id).info.artifact_uri
    assert uri.startswith("mlflow-artifacts:/")
    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ENDPOINT_URL", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, stack.environment[name])
        stored = s3fs.S3FileSystem(skip_instance_cache=True, use_listings_cache=False).find(
            stack.artifact_bucket
        )
    names = {Path(path).name for path in stored if run.run_id in path}
    assert any(name.endswith(".png") for name in names), names
    assert any("model.onnx" in path for path in stored), stored
    assert not list(place.folder.glob("mlruns")) + list(place.folder.glob("runs/mlflow.db"))


def test_denoise_loads_the_registered_champion_through_the_server(champion, place, tmp_path):
    output = tmp_path / "out"
    place.trainer("denoise", "--model", champion, str(FRAME), "--output", str(output))
    assert [read_frame(path).buffers["color"].shape for path in output.rglob("*.exr")]


def test_wrong_password_is_said_in_one_line(place, champion, tmp_path):
    command = ("denoise", "--model", champion, str(FRAME), "--output", str(tmp_path / "out"))
    wrong = Workplace(tmp_path, tmp_path)
    wrong.environment = place.environment | {"MLFLOW_TRACKING_PASSWORD": "wrong"}
    printed = wrong.trainer(*command, code=1)
    assert "Traceback" not in printed
    assert "401" in printed or "password" in printed, printed


def test_serve_runs_the_command_of_the_compose_file(champion, stack):
    server = stack.make_server("serve")
    server.environment |= {"OMP_NUM_THREADS": "1"}
    token = (stack.folder / "secrets" / "serve_token").read_text()
    address = f"http://127.0.0.1:{stack.ports['serve']}/denoise"
    server.start()
    try:
        assert psutil.Process(server.pid).memory_info().rss < PROCESS
        request = urllib.request.Request(
            address, data=FRAME.read_bytes(), headers={"Content-Type": "image/x-exr"}
        )
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(request, timeout=60)
        assert caught.value.code == 401
        caught.value.close()
        request.add_header("Authorization", f"Bearer {token}")
        with urllib.request.urlopen(request, timeout=120) as answer:
            denoised = answer.read()
    finally:
        server.stop()
    path = stack.folder / "served.exr"
    path.write_bytes(denoised)
    assert read_frame(path).buffers["color"].shape[-2:] == read_frame(FRAME).buffers["color"].shape[-2:]
    assert "Traceback" not in server.output(1000)


@pytest.mark.parametrize("name", ["database", "storage", "tracking"])
def test_runs_survive_a_crash_of(name, run, client, stack, place):
    before = client.get_run(run.run_id)
    files = client.list_artifacts(run.run_id)
    stack.servers[name].kill()
    stack.servers[name].start()
    assert client.get_run(run.run_id).data.metrics == before.data.metrics
    assert client.list_artifacts(run.run_id) == files != []


def test_backup_of_the_documentation_restores_a_deleted_run(run, client, stack, tmp_path):
    backup = tmp_path / "mlflow.dump"
    options = ["--username", "mlflow"]
    with backup.open("wb") as file:
        file.write(in_database(stack, "pg_dump", *options, "--format", "custom", "mlflow"))
    client.delete_run(run.run_id)
    stack.tracking.stop()
    in_database(stack, "pg_restore", *options, "--dbname", "mlflow", "--clean", "--if-exists", file=backup)
    in_tracking(stack, "mlflow", "db", "upgrade", "postgresql+psycopg:///mlflow")
    stack.tracking.start()
    assert client.get_run(run.run_id).info.lifecycle_stage == "active"


def in_database(stack, *command, file=None):
    """Run a command as `docker compose exec database` does, and return what it prints."""
    password = (stack.folder / "secrets" / "database_password").read_text()
    with (file or Path(os.devnull)).open("rb") as source:
        return subprocess.run(
            stack.words(list(command), stack.services["database"]), stdin=source, check=True,
            env=stack.database.environment | {"PGPASSWORD": password}, stdout=subprocess.PIPE,
        ).stdout  # fmt: skip


def in_tracking(stack, *command):
    """Run a command as `docker compose run tracking` does."""
    service = stack.services["tracking"]
    subprocess.run(
        stack.words([*service.entrypoint, *command], service), env=stack.service_environment("tracking"),
        check=True, capture_output=True, cwd=stack.folder / "tracking",
    )  # fmt: skip


def test_servers_write_to_their_volumes_only(run, stack):
    # Their containers have read-only root file systems.
    assert not list((stack.folder / "tracking").iterdir())
    assert subprocess.run(stack.tracking.health, env=stack.tracking.environment).returncode == 0
