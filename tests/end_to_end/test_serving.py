"""A trained, registered model served two ways: `trainer serve`, and MLflow's own server around the pyfunc."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

from data.exr import read_frame, write_frame
from tests.trainer.serving.running import frame

pytestmark = pytest.mark.slow
PATIENCE = 240


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def fetch(url: str, content: bytes | None = None, kind: str = "application/json") -> bytes:
    request = urllib.request.Request(url, content, {"Content-Type": kind} if content else {})
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
        return answer.read()


def wait_for(url: str, process: subprocess.Popen[bytes], log) -> None:
    until = time.monotonic() + PATIENCE
    while True:
        try:
            fetch(url)
            return
        except (urllib.error.URLError, ConnectionError):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.2)


class Server:
    """A server as a process of its own; ended with its children."""

    def __init__(self, command: list[str], place, log, health: str) -> None:
        self.log = log
        with log.open("wb") as sink:
            self.process = subprocess.Popen(
                command, cwd=place.folder, env=place.environment | self._variables(place), stdout=sink,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self.health = health

    def _variables(self, place) -> dict[str, str]:
        return {
            "MLFLOW_TRACKING_URI": f"sqlite:///{place.folder / 'runs' / 'mlflow.db'}",
            "PATH": f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}",
        }

    def __enter__(self) -> Server:
        wait_for(self.health, self.process, self.log)
        return self

    def __exit__(self, *exception: object) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
            self.process.wait(60)


def test_trainer_serve_answers_like_trainer_denoise_and_ends_on_sigterm(trained, tmp_path):
    write_frame(frame(70, 90), tmp_path / "f.exr")
    port = free_port()
    command = [sys.executable, "-m", "trainer", "serve", "--model", "models:/wskp/1", "--port", str(port)]
    with Server(command, trained, tmp_path / "log", f"http://127.0.0.1:{port}/health") as server:
        content = (tmp_path / "f.exr").read_bytes()
        answer = fetch(f"http://127.0.0.1:{port}/denoise", content, "image/x-exr")
        os.kill(server.process.pid, signal.SIGTERM)
        assert server.process.wait(60) == 0
    assert "Traceback" not in server.log.read_text()
    (tmp_path / "served.exr").write_bytes(answer)
    trained.trainer(
        "denoise", "--model", "models:/wskp/1", str(tmp_path / "f.exr"), "--output", str(tmp_path / "o")
    )
    served, expected = (
        read_frame(p).buffers["color"] for p in (tmp_path / "served.exr", tmp_path / "o" / "f.exr")
    )
    np.testing.assert_array_equal(served, expected)


@pytest.mark.filterwarnings("ignore:.*Any type hint is inferred")  # MLflow's own, while it is imported
def test_mlflow_models_serve_answers_with_the_picture_of_the_pyfunc(trained, tmp_path):
    import mlflow

    from trainer.export.register import using_store

    port = free_port()
    options = ["-m", "models:/wskp/1", "--env-manager", "local", "--host", "127.0.0.1", "--port", str(port)]
    command = [sys.executable, "-m", "mlflow", "models", "serve", *options]
    shown = frame(20, 24)
    color, albedo = shown.buffers["color"], shown.buffers["albedo"]
    arrays = {"irradiance": color / albedo, "albedo": albedo, "normal": shown.buffers["normal"],
              "depth": shown.buffers["depth"]}  # fmt: skip
    inputs = {name: array.transpose(2, 0, 1)[None] for name, array in arrays.items()}
    inputs["exposure"] = np.ones(1, np.float32)
    body = json.dumps({"inputs": {name: array.tolist() for name, array in inputs.items()}}).encode()
    with Server(command, trained, tmp_path / "log", f"http://127.0.0.1:{port}/ping"):
        answer = json.loads(fetch(f"http://127.0.0.1:{port}/invocations", body))
        with pytest.raises(urllib.error.HTTPError, match="400"):
            fetch(f"http://127.0.0.1:{port}/invocations", b'{"inputs": {"albedo": [[1]]}}')
    with using_store(f"sqlite:///{trained.folder / 'runs' / 'mlflow.db'}"):
        expected = mlflow.pyfunc.load_model("models:/wskp/1").predict(inputs)["color"]
    assert np.asarray(answer["predictions"]["color"]).shape == (1, 3, 20, 24)
    np.testing.assert_allclose(answer["predictions"]["color"], expected, rtol=1e-6)
