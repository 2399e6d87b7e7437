"""The commands of the README's page "From a laptop to a cluster", run one after the other by a newcomer."""

import os
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from data.exr import read_frame
from data.sample import SAMPLES
from tests.end_to_end.conftest import Workplace, cache  # noqa: F401  # a fixture
from tests.stack.compose import ROOT
from tests.stack.processes import free_ports
from trainer.tracking import open_client

PAGE = "## From a laptop to a cluster\n"
SMOKE = " --config smoke.yaml --trainer.accelerator cpu --data.init_args.train_patches 80"


def commands():
    """Return the commands of the page in their order, each on one line."""
    text = (ROOT / "README.md").read_text().partition(PAGE)[2].partition("\n## ")[0]
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    return "\n".join(lines).replace("\\\n", " ").splitlines()


TRAINING = [
    c for c in commands() if " fit " in c or c.startswith(("trainer submit --config", "trainer tune"))
]
OTHERS = [c for c in commands() if c not in TRAINING and not c.startswith(("trainer serve", "curl"))]


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


def test_page_has_every_kind_of_command():
    words = {" ".join(command.split()[:2]) for command in commands()}
    assert words >= {"trainer fit", "trainer submit", "trainer tune", "trainer prepare", "trainer inspect",
                     "trainer sync", "trainer serve"}  # fmt: skip
    assert len(TRAINING) == 5
    assert len(commands()) == len(TRAINING) + len(OTHERS) + 2


@pytest.mark.slow
@pytest.mark.parametrize("command", OTHERS)
def test_command_of_the_page_does_what_it_says(command, place):
    printed = shell(place, command)
    if "submit prepare" in command:
        assert (place.folder / "shards" / "index.json").is_file()
    if "render" in command:
        assert (place.folder / "stills" / "manifest.json").is_file()
    assert printed.strip()


@pytest.mark.slow
@pytest.mark.parametrize("command", TRAINING)
def test_training_of_the_page_ends_with_a_finished_run(command, place, stack, monkeypatch):
    for name, value in stack.environment.items():
        monkeypatch.setenv(name, value)
    client = open_client(stack.tracking_uri)
    if "s3://" in command:
        shell(place, "trainer prepare frames --output s3://penumbra/shards --force")
    shell(place, command + SMOKE)
    experiments = [e.experiment_id for e in client.search_experiments()]
    newest = client.search_runs(experiments, order_by=["attributes.start_time DESC"], max_results=1)[0]
    assert newest.info.status == "FINISHED"


@pytest.mark.slow
def test_model_of_the_page_is_served(place, stack, monkeypatch):
    for name, value in stack.environment.items():
        monkeypatch.setenv(name, value)
    if not open_client(stack.tracking_uri).search_model_versions("name='wskp'"):
        shell(place, TRAINING[0] + SMOKE)
    open_client(stack.tracking_uri).set_registered_model_alias("wskp", "champion", "1")
    serve, curl = commands()[-2:]
    (port,) = free_ports(1)
    server = place.start(*serve.split()[1:], "--port", str(port))
    try:
        wait_until_healthy(port, server)
        shell(place, curl.replace("localhost:8080", f"127.0.0.1:{port}") + " --fail --silent --show-error")
    finally:
        server.terminate()
        server.communicate(timeout=60)
    assert read_frame(place.folder / "denoised.exr").height == 180


def wait_until_healthy(port, server):
    deadline = time.monotonic() + 120
    while server.poll() is None and time.monotonic() < deadline:
        try:
            if urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).status == 200:
                return
        except OSError:
            time.sleep(0.3)
    raise AssertionError("the server does not answer")
