"""Figure 4 of the service: requests per second, latency, memory, and what malformed requests do to it.

    python -m tests.benchmarks serve
    python -m tests.benchmarks.serve --seconds 10 --malformed 500

A full WSKP with random weights is served by `trainer serve` in a process of its own, with its defaults.
Frames have 512x512 pixels in ten channels. The clients are threads of another process; each sends its next
request when it has its answer, over one connection. Memory is that of the server and its readers, looked at
twice a second. Requests take some and give it back, and what stays shows in the lows: memory is flat where
the least of the last third of a run is that of the first. `closed`: the connection of a torn request, which
the server closed without an answer.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.benchmarks.timing import Row, print_table, row

SIZE = 512
CLIENTS = (1, 4, 16)
FLAT = 1.1
"""Least resident memory in the last third of a run over that in the first, at most."""
LOOK_S = 0.5

PATIENCE = 300.0
EXR = {"Content-Type": "image/x-exr"}


def run(seconds: float = 60.0, malformed: int = 10_000, clients: tuple[int, ...] = CLIENTS) -> list[Row]:
    """Measure.

    Args:
        seconds: Of each number of clients.
        malformed: Requests that are wrong.
        clients: Numbers of them.
    """
    with tempfile.TemporaryDirectory() as name, _server(Path(name)) as server:
        folder = Path(name)
        _drive(server, folder, max(clients), seconds / 4)  # allocators and caches fill
        rows = []
        for number in clients:
            rows += _load(server, folder, number, seconds)
        rows += _single(server, folder)
        rows += _malformed(server, folder, malformed)
    return rows


class _Served:
    """The server's process and address."""

    def __init__(self, process: subprocess.Popen[bytes], port: int) -> None:
        self.process, self.port = process, port

    def memory(self) -> float:
        """Return the resident bytes of the server and its readers, in MB."""
        import psutil

        parent, total = psutil.Process(self.process.pid), 0
        for process in [parent, *parent.children(recursive=True)]:
            with suppress(psutil.NoSuchProcess):  # a reader that is replaced this moment
                total += process.memory_info().rss
        return total / 1e6

    @contextmanager
    def watched(self, name: str) -> Iterator[list[Row]]:
        """Look at the memory meanwhile; what was seen is in the rows when the block has ended."""
        seen: list[float] = []
        over = threading.Event()

        def look() -> None:
            while not over.wait(LOOK_S):
                seen.append(self.memory())

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        rows: list[Row] = []
        try:
            yield rows
        finally:
            over.set()
            thread.join()
        third = max(1, len(seen) // 3)
        growth = min(seen[-third:]) / min(seen[:third])
        rows.append(row(f"{name}: resident memory, most", max(seen), "MB"))
        rows.append(
            row(f"{name}: least memory, last third / first", growth, "x", f"<= {FLAT:g}", growth <= FLAT)
        )

    def metric(self, name: str) -> float:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.request("GET", "/metrics")
        lines = connection.getresponse().read().decode().splitlines()
        connection.close()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))


@contextmanager
def _server(folder: Path) -> Iterator[_Served]:
    """Serve random weights on a free port."""
    _write_inputs(folder)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    log = folder / "log"
    options = ["--model", str(folder / "wskp.ckpt"), "--port", str(port), "--queue", "32", "--quiet"]
    command = [sys.executable, "-m", "trainer", "serve", *options]
    with log.open("wb") as sink:
        process = subprocess.Popen(command, stdout=sink, stderr=sink)
    served = _Served(process, port)
    try:
        until = time.monotonic() + PATIENCE
        while not _answers(port):
            if process.poll() is not None or time.monotonic() > until:
                raise RuntimeError(f"the server did not start:\n{log.read_text()}")
            time.sleep(0.2)
        yield served
    finally:
        process.terminate()
        process.wait()


def _answers(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=1):
            return True
    except OSError:
        return False


def _write_inputs(folder: Path) -> None:
    import torch

    from data.exr import write_frame
    from models import WSKP
    from tests.trainer.serving.running import frame

    torch.manual_seed(0)
    weights = {f"net.{name}": value for name, value in WSKP().state_dict().items()}
    tree = {"net": {"class_path": "models.WSKP", "init_args": {}}}
    torch.save({"hyper_parameters": tree, "state_dict": weights}, folder / "wskp.ckpt")
    write_frame(frame(SIZE, SIZE), folder / "frame.exr")


def _drive(server: _Served, folder: Path, clients: int, seconds: float) -> dict[str, Any]:
    """Run the load generator as a process of its own and return what it measured."""
    return _generator(["load", str(server.port), str(folder / "frame.exr"), str(clients), str(seconds)])


def _generator(arguments: list[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.benchmarks.serve", "--generate", *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    measured: dict[str, Any] = json.loads(printed)
    return measured


def _load(server: _Served, folder: Path, clients: int, seconds: float) -> list[Row]:
    name = f"{clients} client{'s' * (clients > 1)}, {SIZE}x{SIZE}"
    tiles, batches = (server.metric(f"penumbra_{name}_total") for name in ("tiles", "batches"))
    with server.watched(name) as watched:
        measured = _drive(server, folder, clients, seconds)
    joined = (server.metric("penumbra_tiles_total") - tiles) / max(
        server.metric("penumbra_batches_total") - batches, 1
    )
    times = sorted(measured["seconds"])
    failed = sum(count for status, count in measured["statuses"].items() if status != "200")
    return [
        row(f"{name}: requests", len(times) / measured["wall"], "1/s"),
        row(f"{name}: latency, median", 1e3 * statistics.median(times), "ms"),
        row(f"{name}: latency, 99 of 100", 1e3 * times[min(len(times) - 1, int(0.99 * len(times)))], "ms"),
        row(f"{name}: tiles in a call of the model", joined, ""),
        row(f"{name}: answers other than 200", failed, "", "0", failed == 0),
        *watched,
    ]


def _single(server: _Served, folder: Path) -> list[Row]:
    """Say what the model alone takes, in this process, with as many threads."""
    import torch

    from tests.benchmarks.timing import medians
    from trainer.loading import resolve

    net = resolve(str(folder / "wskp.ckpt")).deployed
    buffers = {name: torch.rand(1, 1 if name == "depth" else 3, SIZE, SIZE) for name in net.inputs}
    with torch.inference_mode():
        taken = medians({"net": lambda: net(buffers)}, {"net": 9})["net"]
    return [row(f"the model alone, {SIZE}x{SIZE}", 1e3 * taken, "ms")]


def _malformed(server: _Served, folder: Path, count: int) -> list[Row]:
    with server.watched("malformed requests") as watched:
        measured = _generator(["malformed", str(server.port), str(folder), str(count)])
    statuses: dict[str, int] = measured["statuses"]
    rows = [
        row(f"malformed requests answered with {status}", n, "") for status, n in sorted(statuses.items())
    ]
    wrong = sum(n for status, n in statuses.items() if status.startswith("5") or status == "dead")
    alive = server.process.poll() is None and _drive(server, folder, 1, 1.0)["statuses"].keys() == {"200"}
    deaths = server.metric("penumbra_reader_deaths")
    return [
        *rows,
        row("malformed requests: crashes and answers of 500 and above", wrong, "", "0", wrong == 0),
        row("malformed requests: server alive and right afterwards", float(alive), "", "1", alive),
        row("malformed requests: readers that died", deaths, ""),
        row("malformed requests", count / measured["wall"], "1/s"),
        *watched,
    ]


def _generate(arguments: list[str]) -> dict[str, Any]:
    """Be the load generator."""
    start = time.perf_counter()
    if arguments[0] == "load":
        port, path, clients, seconds = int(arguments[1]), arguments[2], int(arguments[3]), float(arguments[4])
        measured = _load_from_here(port, Path(path).read_bytes(), clients, seconds)
    else:
        measured = {"statuses": _send_malformed(int(arguments[1]), Path(arguments[2]), int(arguments[3]))}
    return measured | {"wall": time.perf_counter() - start}


def _load_from_here(port: int, content: bytes, clients: int, seconds: float) -> dict[str, Any]:
    times: list[float] = []
    statuses: Counter[str] = Counter()
    until = time.perf_counter() + seconds

    def client() -> None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
        while time.perf_counter() < until:
            start = time.perf_counter()
            connection.request("POST", "/denoise", content, EXR)
            answer = connection.getresponse()
            answer.read()
            times.append(time.perf_counter() - start)
            statuses[str(answer.status)] += 1

    _together(client, clients)
    return {"seconds": times, "statuses": dict(statuses)}


def _together(work: Callable[[], None], count: int) -> None:
    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _send_malformed(port: int, folder: Path, count: int) -> dict[str, int]:
    """Send files and requests that are wrong, eight at a time, and return how often each status came."""
    from tests.trainer.serving.mutations import mutated, seeds

    originals = seeds(folder)
    statuses: Counter[str] = Counter()
    numbers, lock = iter(range(count)), threading.Lock()

    def client() -> None:
        for number in numbers:
            choice = random.Random(number)
            request, torn = _wrong(mutated(choice.choice(originals), choice), choice)
            # Most that are torn end; the others leave the server waiting.
            status = _status(port, request, torn and choice.random() < 0.95)
            status = "dead" if status == "closed" and not torn else status
            with lock:
                statuses[status] += 1

    _together(client, 8)
    return dict(statuses)


TYPES = ("text/plain", "multipart/form-data; boundary=x", "multipart/form-data", "application/zip", "")


def _wrong(body: bytes, choice: random.Random) -> tuple[bytes, bool]:
    """Return a request around a damaged file, and whether it may be torn off."""
    kind = choice.random()
    if kind < 0.1:
        return _wrong_http(body, choice), True
    if kind < 0.2:
        return _request(body[: choice.randrange(len(body))], choice.choice(TYPES), len(body)), True
    if kind < 0.25:
        return _request(body[: len(body) // 2], "image/x-exr", len(body)), True
    return _request(body, "image/x-exr", len(body)), False


def _request(body: bytes, kind: str, length: int) -> bytes:
    head = f"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\r\n"
    return head.encode() + body


def _wrong_http(body: bytes, choice: random.Random) -> bytes:
    """Return a request with bytes of its head changed, or a form made of noise."""
    request = bytearray(_request(b"--x\r\n" + body, "multipart/form-data; boundary=x", len(body) + 5))
    for _ in range(choice.randrange(4)):
        request[choice.randrange(100)] = choice.randrange(256)
    return bytes(request)


def _status(port: int, request: bytes, ends: bool) -> str:
    """Send bytes, end the sending side or leave it open, and return the status of the answer.

    `closed` where the server closed without one, as it may where a client stops in the middle of its request;
    `dead` where it cannot be reached or does not answer.
    """
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
            try:
                connection.sendall(request)
                if ends:
                    connection.shutdown(socket.SHUT_WR)
                answer = b""
                while b"\r\n" not in answer and (piece := connection.recv(4096)):
                    answer += piece
            except (ConnectionResetError, BrokenPipeError):
                return "closed"
            return answer.split(b" ")[1].decode() if answer.startswith(b"HTTP/") else "closed"
    except OSError:
        return "dead"


def main() -> int:
    """Run on the command line."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the trainer command does, before torch
    if sys.argv[1:2] == ["--generate"]:
        print(json.dumps(_generate(sys.argv[2:])))
        return 0
    parser = argparse.ArgumentParser(description="Measure `trainer serve`.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--malformed", type=int, default=10_000)
    args = parser.parse_args()
    rows = run(args.seconds, args.malformed)
    print_table(rows)
    return 1 if any(entry["meets"] is False for entry in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
