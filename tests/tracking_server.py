"""A tracking server for tests, and a proxy before it that fails as servers do.

    python -m tests.tracking_server FOLDER PORT [DELAY_S]

runs MLflow's own server application on a database in FOLDER, without the processes that `mlflow server`
starts around it, so that it is there within seconds. A delay makes every answer late.
"""

from __future__ import annotations

import http.client
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@contextmanager
def running(folder: Path, delay_s: float = 0.0, priority: int = 0) -> Iterator[str]:
    """Run a server in a process of its own, with a priority as of `nice`; yields its URI."""
    port = free_port()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MLFLOW_")}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.tracking_server", str(folder), str(port), str(delay_s)],
        env=environment | {"MLFLOW_DISABLE_TELEMETRY": "true"},
        cwd=Path(__file__).parents[1],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        uri = f"http://127.0.0.1:{port}"
        wait_until_up(uri, process)
        os.setpriority(os.PRIO_PROCESS, process.pid, priority)
        yield uri
    finally:
        process.kill()
        process.wait()


def wait_until_up(uri: str, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        try:
            urllib.request.urlopen(f"{uri}/health", timeout=10).close()
            return
        except OSError:
            time.sleep(0.1)
    raise AssertionError("the tracking server did not start")


class Proxy:
    """Passes requests on to a server, with faults that a test sets while it runs.

    Attributes:
        delay_s: Every answer is late by so much.
        status: What every request is answered with, where not None.
        refuse: Paths that contain this are answered with `status` only.
        log: Method and path of every request.
    """

    def __init__(self, server: str) -> None:
        self.delay_s = 0.0
        self.status: int | None = None
        self.refuse = ""
        self.log: list[str] = []
        self._server = server
        self._port = free_port()
        self._http: ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self._port}"

    def start(self) -> Proxy:
        """Listen."""
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            def do(self) -> None:
                proxy.answer(self)

            do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = do  # noqa: N815

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", self._port), Handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()
        return self

    def stop(self) -> None:
        """Refuse connections."""
        if self._http is not None and self._thread is not None:
            self._http.shutdown()
            self._thread.join()
            self._http.server_close()
            self._http = None

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        self.log.append(f"{request.command} {request.path}")
        body = request.rfile.read(int(request.headers.get("Content-Length") or 0))
        if self.delay_s:
            time.sleep(self.delay_s)
        if self.status is not None and self.refuse in request.path:
            status, data, kind = self.status, b"no", "text/plain"
        else:
            status, data, kind = self._pass_on(request, body)
        try:
            request.send_response(status)
            request.send_header("Content-Type", kind)
            request.send_header("Content-Length", str(len(data)))
            request.end_headers()
            request.wfile.write(data)
        except OSError:
            pass  # the client has given up

    def _pass_on(self, request: BaseHTTPRequestHandler, body: bytes) -> tuple[int, bytes, str]:
        connection = http.client.HTTPConnection(self._server.removeprefix("http://"), timeout=60)
        try:
            headers = {k: v for k, v in request.headers.items() if k.lower() not in ("host", "connection")}
            connection.request(request.command, request.path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.read(), answer.headers.get("Content-Type", "")
        finally:
            connection.close()


def serve(folder: Path, port: int, delay_s: float) -> None:
    """Serve until the process is killed."""
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["_MLFLOW_SERVER_FILE_STORE"] = f"sqlite:///{folder.resolve()}/mlflow.db"
    os.environ["_MLFLOW_SERVER_ARTIFACT_ROOT"] = "mlflow-artifacts:/"
    os.environ["_MLFLOW_SERVER_ARTIFACT_DESTINATION"] = str(folder.resolve() / "artifacts")
    os.environ["_MLFLOW_SERVER_SERVE_ARTIFACTS"] = "true"
    from mlflow.server import app
    from mlflow.server.handlers import initialize_backend_stores
    from werkzeug.serving import make_server

    initialize_backend_stores(os.environ["_MLFLOW_SERVER_FILE_STORE"], None, "mlflow-artifacts:/")

    def late(environment, start):  # type: ignore[no-untyped-def]
        if delay_s and environment["PATH_INFO"] != "/health":
            time.sleep(delay_s)
        return app(environment, start)

    make_server("127.0.0.1", port, late, threaded=True).serve_forever()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 0.0)
