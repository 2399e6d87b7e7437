"""The commands of the README's page "From a laptop to a cluster", run one after the other by a newcomer."""

import os
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from data import remote
from data.exr import read_frame
from data.frames import FrameSet
from data.sample import SAMPLES
from data.shards.index import Index
from tests.end_to_end.conftest import Workplace, cache  # noqa: F401  # a fixture
from tests.stack.compose import ROOT
from tests.stack.processes import free_ports
from trainer.tracking import open_client

PAGE = "## From a laptop to a cluster\n"
SMOKE = " --config smoke.yaml --data.init_args.train_patches 80"
CPU = " --trainer.accelerator cpu"  # Ray decides by itself


def commands():
    """Return the commands of the page in their order, each on one line."""
    text = (ROOT / "README.md").read_text().partition(PAGE)[2].partition("\n## ")[0]
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    return "\n".join(lines).replace("\\\n", " ").splitlines()


TRAINING = [
    c for c in commands() if " fit " in c or c.startswith(("trainer submit --config", "trainer tune"))
]


def only(beginning):
    """Return the one command that begins so."""
    (command,) = [command for command in commands() if command.startswith(beginning)]
    return command


@pytest.fixture(scope="module")
def place(stack, tmp_path_factory, cache):  # noqa: F811
    place = Workplace(tmp_path_factory.mktemp("page"), cache)
    place.environment |= stack.environment
    place.environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    shutil.copytree(SAMPLES["bmfr"], place.folder / "frames")
    return place


def shell(place, command):
    done = subprocess.run(
        ["sh", "-c", command], cwd=place.folder, env=place.environment, capture_output=True, text=True,
        timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def client(stack):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in stack.environment.items():
            patch.setenv(name, value)
        yield open_client(stack.tracking_uri)


def runs_of(client):
    """Return the runs of all experiments by their number."""
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    return {run.info.run_id: run for run in client.search_runs(experiments, max_results=1000)}


def test_page_has_every_kind_of_command():
    others = ("trainer submit prepare", "trainer submit render", "trainer prepare", "trainer inspect",
              "trainer sync", "trainer serve", "curl")  # fmt: skip
    assert len(TRAINING) == 5
    assert sorted(commands()) == sorted([*TRAINING, *map(only, others)])


@pytest.mark.slow
def test_a_cluster_prepares_the_shards_that_one_process_does(place):
    shell(place, only("trainer submit prepare"))
    shell(place, "trainer prepare frames --output alone")
    made, alone = (Index.read(place.folder / name) for name in ("shards", "alone"))
    assert [shard.sha256 for shard in made.shards] == [shard.sha256 for shard in alone.shards]
    assert made.count("train") > 0


@pytest.mark.slow
def test_a_cluster_renders_every_frame(place):
    shell(place, only("trainer submit render"))
    frames = FrameSet(place.folder / "stills")
    assert len(frames.scenes()) == 2
    for scene in frames.scenes():
        for record in frames.frames(scene):
            assert frames.read(scene, record.index).buffers["color"].shape == (32, 32, 3)
        assert frames.frames(scene)


@pytest.mark.slow
def test_shards_in_a_store_are_complete_and_told(place, client):
    shell(place, only("trainer prepare"))
    shell(place, "trainer prepare frames --output alone --force")
    alone = Index.read(place.folder / "alone")
    found = remote.listing("s3://penumbra/shards")
    assert found is not None
    assert found.items() >= {shard.file: shard.bytes for shard in alone.shards}.items()
    for shard in alone.shards:
        assert remote.sha256_of(f"s3://penumbra/shards/{shard.file}", shard.bytes) == shard.sha256
    printed = shell(place, only("trainer inspect"))
    for split in ("train", "validation"):
        assert f"{split}: {alone.count(split)} samples in {len(alone.of(split))} shards" in printed


@pytest.mark.slow
def test_what_a_server_missed_is_sent_later(place, client, stack):
    before = runs_of(client)
    stack.tracking.stop()
    shell(place, TRAINING[0] + SMOKE + CPU)
    stack.tracking.start()
    assert runs_of(client).keys() == before.keys()
    shell(place, only("trainer sync"))
    (new,) = runs_of(client).keys() - before.keys()
    run = client.get_run(new)
    assert run.info.status == "FINISHED"
    assert sorted(entry.step for entry in client.get_metric_history(new, "train/loss_step")) == [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("command", TRAINING)
def test_training_of_the_page_ends_with_finished_runs_of_its_own(command, place, client):
    before = runs_of(client)
    if "s3://" in command:
        shell(place, "trainer prepare frames --output s3://penumbra/shards --force")
    shell(place, command + SMOKE + (CPU if " fit " in command else ""))
    new = {number: run for number, run in runs_of(client).items() if number not in before}
    assert {run.info.status for run in new.values()} == {"FINISHED"}
    parents = [run.data.tags.get("mlflow.parentRunId") for run in new.values()]
    if "tune" in command:
        (sweep,) = [number for number, parent in zip(new, parents, strict=True) if parent is None]
        assert parents.count(sweep) == 2 == len(new) - 1
        return
    (run,) = new.values()
    assert run.data.metrics["val/psnr_wskp"] > 0
    if "s3://" in command:
        assert "s3://penumbra/shards" in run.data.params.values()
    if "torchrun" in command:
        assert run.data.params["trainer.devices"] == "2"


@pytest.mark.slow
def test_model_of_the_page_is_served(place, client):
    if not client.search_model_versions("name='wskp'"):
        shell(place, TRAINING[0] + SMOKE + CPU)
    client.set_registered_model_alias("wskp", "champion", "1")
    serve, curl = only("trainer serve"), only("curl")
    (port,) = free_ports(1)
    server = place.start(*serve.split()[1:], "--port", str(port))
    try:
        wait_until_healthy(port, server)
        shell(place, curl.replace("localhost:8080", f"127.0.0.1:{port}") + " --fail --silent --show-error")
    finally:
        server.terminate()
        server.communicate(timeout=60)
    noisy = read_frame(place.folder / "frames" / "classroom" / "f000.exr").buffers["color"]
    denoised = read_frame(place.folder / "denoised.exr").buffers["color"]
    assert denoised.shape == noisy.shape
    assert denoised.std() < noisy.std()


def wait_until_healthy(port, server):
    deadline = time.monotonic() + 120
    while server.poll() is None and time.monotonic() < deadline:
        try:
            if urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).status == 200:
                return
        except OSError:
            time.sleep(0.3)
    raise AssertionError("the server does not answer")
