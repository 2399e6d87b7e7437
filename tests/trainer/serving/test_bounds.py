"""However requests come, what they cost is bounded: places, time, memory, connections."""

from __future__ import annotations

import re
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from models.denoiser import Denoised
from tests.trainer.serving.running import Gate, Running, exr, limits, picture, wait_until
from trainer.serving import server as serving
from trainer.serving.batching import Batcher, Batching
from trainer.serving.limits import Budget, Over, Refusal, Ticket
from trainer.serving.readers import Readers

HEAD = b"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\nContent-Length: %d\r\n\r\n"


@pytest.fixture
def content(tmp_path):
    return exr(tmp_path)


def test_more_requests_than_may_wait_are_told_when_to_come_back(content, tmp_path):
    gate = Gate()
    # One in a batch, one beside it, one that waits.
    with Running(gate, limits(queue=1), most=1) as service, ThreadPoolExecutor(3) as pool:
        answers = [pool.submit(service.post, content) for _ in range(3)]
        wait_until(lambda: service.service.admitted == 3)
        refused = service.post(content)
        assert refused.status_code == 503
        assert int(refused.headers["retry-after"]) >= 1
        assert service.client.get("/health").status_code == 200
        assert service.metric("penumbra_queue_length") == 1
        gate.opened.set()
        for answer in answers:
            assert np.abs(picture(answer.result().content, tmp_path)).max() > 0
        wait_until(lambda: service.service.admitted == 0)
        assert service.post(content).status_code == 200


def test_a_result_that_takes_too_long_is_given_up_at_the_next_tile(tmp_path):
    gate = Gate()
    large = exr(tmp_path, 64, 64)
    with Running(gate, limits(compute=2.0), tile=16) as service:
        late = service.post(large)
        assert late.status_code == 504
        gate.opened.set()
        wait_until(lambda: service.service.admitted == 0)
        assert gate.calls <= 1  # of sixteen
        assert not list(Path(service.service._temporary.name).iterdir())


def test_a_client_that_goes_away_cancels_its_work(tmp_path):
    gate = Gate()
    large = exr(tmp_path, 64, 64)
    with Running(gate, tile=16) as service:
        with service.raw(HEAD % len(large), large):
            wait_until(lambda: gate.calls == 1)
        wait_until(lambda: service.metric("penumbra_abandoned_total") == 1)
        gate.opened.set()
        wait_until(lambda: service.service.admitted == 0)
        assert gate.calls == 1
        assert not list(Path(service.service._temporary.name).iterdir())


def test_a_client_that_goes_away_while_it_sends_leaves_nothing(content):
    with Running(Gate()) as service:
        with service.raw(HEAD % len(content), content[:100]):
            wait_until(lambda: service.service.sending == 1)
        wait_until(lambda: service.service.sending == 0)
        wait_until(lambda: not list(Path(service.service._temporary.name).iterdir()))
        assert service.service.admitted == 0


@pytest.mark.parametrize("pause", [0.1, 5.0])
def test_a_body_that_comes_too_slowly_is_refused(content, pause):
    with Running(Gate(), limits(read=1.0)) as service, service.raw(HEAD % len(content)) as connection:
        answered = threading.Event()

        def drip() -> None:
            for i in range(len(content)):
                if answered.wait(pause):
                    return
                connection.sendall(content[i : i + 1])

        thread = threading.Thread(target=drip)
        thread.start()
        answer = connection.recv(4096)
        answered.set()
        thread.join()
        assert answer.startswith(b"HTTP/1.1 408")
        assert service.service.sending == 0


def test_slow_senders_take_no_more_places_than_there_are(content):
    with Running(Gate(), limits(queue=0, idle=20.0, read=20.0), most=1) as service:
        connections = [service.raw(HEAD % len(content), content[:50]) for _ in range(2)]
        wait_until(lambda: service.service.sending == 2)
        assert service.post(content).status_code == 503
        for connection in connections:
            connection.close()
        wait_until(lambda: service.service.sending == 0)


def test_connections_without_a_request_are_closed(monkeypatch):
    monkeypatch.setattr(serving, "_LOOK", 0.05)
    monkeypatch.setattr(serving, "HEADER_SECONDS", 0.3)
    with Running(Gate()) as service, service.raw(b"POST /denoise HTTP/1.1\r\nHost: x\r\nX: ") as connection:
        assert _rest(connection) == b""


def test_a_result_that_nobody_takes_is_dropped(monkeypatch, tmp_path):
    gate = Gate()
    gate.opened.set()
    large = exr(tmp_path, 200, 220)
    monkeypatch.setattr(serving, "_LOOK", 0.05)
    monkeypatch.setattr(serving, "CLOSE_SECONDS", 0.3)
    with Running(gate, limits(send=0.5)) as service:
        service.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # of connections to come
        with service.raw() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.sendall(HEAD % len(large) + large)
            wait_until(lambda: gate.calls >= 1)
            wait_until(lambda: not service.server.server_state.connections)
            received = _rest(connection)
        assert received.startswith(b"HTTP/1.1 200")
        assert len(received) < int(re.search(rb"content-length: (\d+)", received)[1])
        assert not list(Path(service.service._temporary.name).iterdir())


def _rest(connection: socket.socket) -> bytes:
    received = b""
    with suppress(ConnectionResetError):
        while piece := connection.recv(1 << 16):
            received += piece
    return received


def test_the_server_finishes_what_it_has_and_takes_nothing_new(content, tmp_path):
    gate = Gate()
    with Running(gate) as service, ThreadPoolExecutor(1) as pool:
        running = pool.submit(service.post, content)
        wait_until(lambda: gate.calls == 1)
        service.server.handle_exit(15, None)
        wait_until(lambda: _refused(service))
        gate.opened.set()
        assert running.result().status_code == 200
        service.thread.join()
    assert service.server._captured_signals == []


def _refused(service):
    try:
        service.raw().close()
    except OSError:
        return True
    return False


def tiled_bomb(path: Path) -> bytes:
    """Return a file of a few kilobytes whose tiles are as large as a header can say."""
    pixels = {f"color.{c}": np.ones((40, 48), np.float32) for c in "RGB"}
    header = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
    content = bytearray(path.read_bytes())
    place = content.index(b"tiles\0tiledesc\0") + len(b"tiles\0tiledesc\0") + 4
    content[place : place + 8] = (1 << 14).to_bytes(4, "little") * 2
    return bytes(content)


def test_a_file_that_makes_the_decoder_take_all_memory_is_refused_within_bounds(tmp_path):
    with Running(Gate()) as service:
        answer = service.post(tiled_bomb(tmp_path / "bomb.exr"))
        assert answer.status_code == 422
        peaks = [_peak(process._process.pid) for process in service.service.readers._all]
    assert max(peaks) < 450 << 20  # with 64 MB of libraries, and 256 MB of scratch


def _peak(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) << 10


def test_a_reader_that_dies_costs_one_request(tmp_path):
    exr(tmp_path)
    readers = Readers(1, limits())
    ticket = Ticket(time.monotonic() + 60)
    try:
        assert readers.frames(tmp_path, "f0.exr", ticket)[0]["name"] == "f0.exr"
        next(iter(readers._all))._process.kill()
        with pytest.raises(Refusal, match="made the reader"):
            readers.frames(tmp_path, "f0.exr", ticket)
        frame, _ = readers.read(tmp_path, "f0.exr", {}, ticket)
        assert frame.buffers["color"].shape == (24, 40, 3)
        assert readers.deaths == 1
    finally:
        readers.close()


def test_a_reader_that_hangs_is_replaced(tmp_path):
    import os
    import signal

    exr(tmp_path)
    readers = Readers(1, limits(decode=0.3))
    ticket = Ticket(time.monotonic() + 60)
    try:
        os.kill(next(iter(readers._all))._process.pid, signal.SIGSTOP)
        with pytest.raises(Refusal, match="could not be decoded within"):
            readers.frames(tmp_path, "f0.exr", ticket)
        assert readers.deaths == 1
    finally:
        readers.close()


def test_the_budget_lets_one_wait_until_another_is_done_or_its_time_is_up():
    budget = Budget(100)
    ticket, late = Ticket(time.monotonic() + 60), budget.hold(1, Ticket(time.monotonic() + 0.2))
    with budget.hold(70, ticket), budget.hold(30, ticket), pytest.raises(Over):
        late.__enter__()
    with budget.hold(10**9, Ticket(time.monotonic() + 60)):
        assert budget.held == 100
    assert budget.held == 0


def test_a_tile_that_fails_does_not_fail_those_in_its_batch():
    calls = []

    def call(buffers):
        calls.append(len(buffers["color"]))
        if (buffers["color"] < 0).any():
            raise ValueError("negative")
        return Denoised(buffers["color"] + 1)

    entered, gate = threading.Event(), threading.Event()

    def first(buffers):
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(4) as pool:
        held = pool.submit(batcher.run, ticket, first, {"color": torch.zeros(1, 3, 16, 16)})
        assert entered.wait(60)
        values = [torch.full((1, 3, 16, 16), float(v)) for v in (1, -1, 2)]
        waiting = [pool.submit(batcher.run, ticket, call, {"color": value}) for value in values]
        wait_until(lambda: len(batcher._waiting) == 3)
        gate.set()
        held.result()
        assert waiting[0].result().color.max() == 2
        with pytest.raises(ValueError, match="negative"):
            waiting[1].result()
        assert waiting[2].result().color.max() == 3
    batcher.close()
    assert calls == [3, 1, 1, 1]


def test_tiles_of_other_shapes_or_beyond_the_memory_are_batches_of_their_own():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    class Net:
        bytes_per_pixel = 100

        def __call__(self, buffers):
            sizes.append(tuple(buffers["color"].shape))
            entered.set()
            gate.wait(60)
            return Denoised(buffers["color"])

    net = Net()
    batcher = Batcher(Batching(most=8, memory=100 * 16 * 16 * 2, threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(6) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for size in (16, 16, 16, 20):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
        wait_until(lambda: len(batcher._waiting) == 4)
        gate.set()
    batcher.close()
    assert sorted(sizes[1:]) == [(1, 3, 16, 16), (1, 3, 20, 20), (2, 3, 16, 16)]


def test_a_tile_is_taken_from_behind_others_of_another_shape():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    def net(buffers):
        sizes.append(tuple(buffers["color"].shape))
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(threads=1))
    ticket, gone = Ticket(time.monotonic() + 60), Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(8) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for number, size in enumerate((16, 20, 16, 20), 1):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
            wait_until(lambda number=number: len(batcher._waiting) == number)
        dropped = pool.submit(batcher.run, gone, net, {"color": torch.zeros(1, 3, 16, 16)})
        wait_until(lambda: len(batcher._waiting) == 5)
        gone.cancel()
        gate.set()
        with pytest.raises(Over):
            dropped.result()
    assert batcher.alive
    batcher.close()
    assert sizes[1:] == [(2, 3, 16, 16), (2, 3, 20, 20)]


def test_a_service_whose_model_cannot_run_any_more_is_not_healthy():
    with Running(Gate()) as service:
        service.service.batcher.close()
        answer = service.client.get("/health")
        assert (answer.status_code, answer.json()["status"]) == (503, "failed")


def test_large_tiles_are_not_joined_where_that_gains_nothing():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    def net(buffers):
        sizes.append(len(buffers["color"]))
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(most=8, pixels=3 * 16 * 16, threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(8) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for size in (16, 16, 16, 16, 32, 32):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
        wait_until(lambda: len(batcher._waiting) == 6)
        gate.set()
    batcher.close()
    assert sorted(sizes[1:]) == [1, 1, 1, 3]


def test_steps_of_a_classical_method_stop_when_nobody_waits():
    from models.pace import tick

    steps = []
    ticket = Ticket(time.monotonic() + 60)

    def call(buffers):
        for step in range(100):
            steps.append(step)
            if step == 3:
                ticket.cancel()
            tick(0.01)

    batcher = Batcher(Batching(threads=1))
    with pytest.raises(Over):
        batcher.run(ticket, call, {"color": torch.zeros(1, 3, 8, 8)})
    batcher.close()
    assert steps == [0, 1, 2, 3]
