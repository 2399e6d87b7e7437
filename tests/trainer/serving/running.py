"""A service that runs in a thread of the test, on a real port."""

from __future__ import annotations

import io
import socket
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import torch

from data.exr import read_frame, write_frame
from data.frame import Frame
from models import WSKP
from models.denoiser import Buffers, Denoised, Denoiser
from trainer.denoising import Settings
from trainer.export.description import Source
from trainer.loading import Loaded
from trainer.serving.batching import Batching
from trainer.serving.limits import Limits
from trainer.serving.server import make_server
from trainer.serving.service import Service

EXR = {"Content-Type": "image/x-exr"}
LIMITS = Limits(
    megapixels=0.05, upload=3_000_000, frames=5, queue=2, read=2.0, idle=0.5, compute=20.0, decode=5.0
)


class Running:
    """A service and its address."""

    def __init__(self, model: Denoiser, limits: Limits = LIMITS, **options: Any) -> None:
        token, tile, most = options.get("token"), options.get("tile"), options.get("most", 4)
        self.model = model.eval()
        settings = Settings(tile=tile)
        source = Source("models:/net/1", "models.Net")
        self.service = Service(Loaded(self.model, source), settings, limits, Batching(most, threads=1), token)
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.server = make_server(self.service, log_level="critical", access_log=False)
        self.thread = threading.Thread(target=self.server.run, kwargs={"sockets": [self.socket]})
        self.thread.start()
        wait_until(lambda: self.server.started)
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=60, trust_env=False)

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *exception: object) -> None:
        self.client.close()
        self.server.should_exit = True
        self.thread.join()

    def post(self, content: Any, headers: dict[str, str] = EXR, **query: str) -> httpx.Response:
        return self.client.post("/denoise", content=content, headers=headers, params=query)

    def raw(self, *pieces: bytes) -> socket.socket:
        """Return a connection over which bytes were sent as they are."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=30)
        for piece in pieces:
            connection.sendall(piece)
        return connection

    def metric(self, name: str) -> float:
        lines = self.client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))


class Gate(Denoiser):
    """Waits in the model's thread until it is let through."""

    inputs = ("color",)

    def __init__(self) -> None:
        super().__init__()
        self.opened, self.calls = threading.Event(), 0

    def forward(self, buffers: Buffers) -> Denoised:
        self.calls += 1
        assert self.opened.wait(60)
        return Denoised(buffers["color"] * 2)


def wait_until(condition: Any) -> None:
    """Wait for what another thread does; the test fails where it never does."""
    until = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def small_wskp() -> WSKP:
    torch.manual_seed(3)
    return WSKP(layers=2, width=6, kernel_sizes=(3, 5), temporal=False)


def frame(height: int = 24, width: int = 40, seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(height, width, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    buffers = {
        "color": rng.exponential(1, (height, width, 3)), "albedo": rng.uniform(0.1, 0.9, (height, width, 3)),
        "normal": normal, "depth": rng.uniform(1, 9, (height, width, 1)),
    }  # fmt: skip
    return Frame({name: array.astype(np.float32) for name, array in buffers.items()}, "room", seed)


def exr(folder: Path, height: int = 24, width: int = 40, seed: int = 0) -> bytes:
    """Return an EXR file, which stays in the folder as well."""
    path = folder / f"f{seed}.exr"
    write_frame(frame(height, width, seed), path)
    return path.read_bytes()


def zipped(members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return memory.getvalue()


def picture(content: bytes, folder: Path) -> np.ndarray[Any, Any]:
    """Return the colour of an EXR file."""
    path = folder / "answer.exr"
    path.write_bytes(content)
    return read_frame(path).buffers["color"]


def limits(**changes: Any) -> Limits:
    return replace(LIMITS, **changes)
