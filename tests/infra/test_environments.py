"""The environment of the tracking server's image, made with the image's own command."""

import subprocess
import sys
import venv

import pytest

from tests.infra.test_images import STAGES
from tests.stack.compose import ROOT


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_tracking_server_runs_in_its_environment_without_pytorch(tmp_path):
    command = STAGES["tracking-environment"].last("RUN")
    assert command.startswith("pip install ")
    assert "&&" not in command
    venv.create(tmp_path / "venv", with_pip=True)
    bin = tmp_path / "venv" / "bin"
    command = command.replace("/constraints.txt", str(ROOT / "constraints.txt"))
    subprocess.run(f"{bin}/{command} --quiet", shell=True, check=True, cwd=tmp_path)
    imports = "import mlflow.server.auth.db.utils, mlflow.server.fastapi_app, boto3, psycopg, flask_wtf"
    subprocess.run([bin / "python", "-W", "ignore", "-c", imports], check=True, cwd=tmp_path)
    listed = subprocess.run([bin / "pip", "list"], check=True, capture_output=True, text=True).stdout
    assert "torch" not in listed.split()
    options = STAGES["tracking"].command[2:]
    helped = subprocess.run([bin / "mlflow", "server", "--help"], check=True, capture_output=True, text=True)
    assert all(option.split("=")[0] in helped.stdout for option in options)
    assert sys.version_info[:2] == (3, 11)
