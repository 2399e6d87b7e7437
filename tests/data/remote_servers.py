"""Servers on loopback for tests: a real S3 server, and a web server that fails as it is told."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

KEY, SECRET = "penumbra-test-key", "penumbra-test-secret-key-0123456789"
WEED = Path(sys.executable).with_name("weed")


class S3Server:
    """SeaweedFS with credentials; can be killed, and started again on the same port with the same content."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ports = free_ports(8)
        self.process: subprocess.Popen[bytes] | None = None
        self.environment = {
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.ports[6]}",
            "AWS_REGION": "us-east-1",
        }

    def start(self) -> None:
        names = ("master.port", "master.port.grpc", "volume.port", "volume.port.grpc", "filer.port",
                 "filer.port.grpc", "s3.port", "s3.port.grpc")  # fmt: skip
        ports = [f"-{name}={port}" for name, port in zip(names, self.ports, strict=True)]
        self.folder.mkdir(exist_ok=True)
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [WEED, "server", f"-dir={self.folder}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", *ports,
                 "-filer",
                 "-s3", "-s3.iam=false", "-s3.port.iceberg=0", "-s3.port.lance=0", "-master.telemetry=false",
                 "-master.volumeSizeLimitMB=64", "-volume.max=100", "-volume.minFreeSpace=0"],
                env={**os.environ, **self.environment}, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        deadline = time.monotonic() + 90
        while not self._answers():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.stop()
                raise RuntimeError(
                    f"the S3 server did not start: {(self.folder / 'log').read_text()[-2000:]}"
                )
            time.sleep(0.1)

    def _answers(self) -> bool:
        """Return whether it can store something."""
        return bucket_command(self.environment, "list_buckets")

    def make_bucket(self, name: str) -> None:
        deadline = time.monotonic() + 60
        while not bucket_command(self.environment, "create_bucket", name):
            if time.monotonic() > deadline:
                raise RuntimeError(f"the S3 server makes no bucket {name}")
            time.sleep(0.2)

    def stop(self) -> None:
        """Kill it, as a crash would."""
        if self.process is not None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait()
            self.process = None


def bucket_command(environment: dict[str, str], name: str, bucket: str | None = None) -> bool:
    """Run a command of S3; returns whether it succeeded."""
    import botocore.config
    import botocore.exceptions
    import botocore.session

    client = botocore.session.get_session().create_client(
        "s3", "us-east-1", endpoint_url=environment["AWS_ENDPOINT_URL"],
        aws_access_key_id=environment["AWS_ACCESS_KEY_ID"],
        aws_secret_access_key=environment["AWS_SECRET_ACCESS_KEY"],
        config=botocore.config.Config(
            s3={"addressing_style": "path"}, retries={"total_max_attempts": 1}, connect_timeout=2,
            read_timeout=10,
        ),
    )  # fmt: skip
    try:
        getattr(client, name)(**({"Bucket": bucket} if bucket else {}))
    except (botocore.exceptions.BotoCoreError, botocore.exceptions.ClientError):
        return False
    finally:
        client.close()
    return True


def free_ports(count: int) -> list[int]:
    """Return ports of loopback that nobody uses."""
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


Fault = Callable[["Handler", bytes], bool]
"""Answers a request in place of the server, or returns False; is given the file."""


class QuietServer(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing of clients that leave."""


class WebServer:
    """Serves a folder over HTTP: GET, HEAD, ranges, PUT and DELETE.

    Attributes:
        fault: Asked about each GET of a file, None for no faults.
        ranges: Answer requests for a part with the part.
        asked: Number of requests of each kind and path.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fault: Fault | None = None
        self.ranges = True
        self.asked: Counter[str] = Counter()
        self._server = QuietServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._server.web = self  # type: ignore[attr-defined]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> WebServer:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._server.shutdown()
        self._server.server_close()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        pass

    @property
    def web(self) -> WebServer:
        return self.server.web  # type: ignore[attr-defined,no-any-return]

    @property
    def file(self) -> Path:
        return self.web.folder / self.path.partition("?")[0].lstrip("/")

    def answer(self, status: int, body: bytes = b"", claimed: int | None = None, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if claimed is None else claimed))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self.web.asked[f"{self.command} {self.path}"] += 1
        if not self.file.is_file():
            self.answer(404, b"not here")
            return
        data = self.file.read_bytes()
        if self.command == "GET" and self.web.fault is not None and self.web.fault(self, data):
            return
        part = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if part and self.web.ranges:
            first, last = map(int, part.groups())
            place = f"bytes {first}-{last}/{len(data)}"
            self.answer(206, data[first : last + 1], Content_Range=place)
        else:
            self.answer(200, data)

    def do_PUT(self) -> None:
        self.web.asked[f"PUT {self.path}"] += 1
        body = b""
        if self.headers.get("Transfer-Encoding") == "chunked":
            while size := int(self.rfile.readline(), 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        else:
            body = self.rfile.read(int(self.headers["Content-Length"]))
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_bytes(body)
        self.answer(201)

    def do_DELETE(self) -> None:
        self.web.asked[f"DELETE {self.path}"] += 1
        found = self.file.is_file()
        self.file.unlink(missing_ok=True)
        self.answer(204 if found else 404)
