"""However requests come, what they cost is bounded: places, time, memory, connections."""

from __future__ import annotations

import errno
import os
import re
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from tests.trainer.serving.running import Gate, Running, exr, limits, picture, wait_until, zipped
from trainer.serving import server as serving
from trainer.serving.limits import Budget, Over, Ticket

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


def test_all_uploads_together_take_no_more_room_than_there_is(content):
    with Running(Gate(), limits(disk=len(content) + 100, idle=20.0, read=20.0)) as service:
        with service.raw(HEAD % len(content), content[:200]):
            wait_until(lambda: service.service.room.taken == 200)
            for body in (content, iter([content])):  # the second one announces no length
                refused = service.post(body)
                assert refused.status_code == 503
                assert "no room" in refused.json()["detail"]
                assert int(refused.headers["retry-after"]) >= 1
        wait_until(lambda: service.service.room.taken == 0)
        assert service.client.get("/health").status_code == 200


def test_what_a_zip_file_unpacks_to_and_results_take_room(content):
    gate = Gate()
    gate.opened.set()
    body = zipped({"f1.exr": content, "f2.exr": content})
    largest = int(2.5 * len(body))  # the file and what it unpacks to, but no results
    for disk, status in ((largest - len(body), 413), (largest, 413), (10_000_000, 200)):
        with Running(gate, limits(disk=disk)) as service:
            calls = gate.calls
            answer = service.post(body, {"Content-Type": "application/zip"})
            assert answer.status_code == status, answer.text
            assert (gate.calls > calls) == (disk >= largest)
            wait_until(lambda service=service: service.service.room.taken == 0)


def full_disk(*args, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def full_disk_by_openexr(*args, **options):
    try:
        raise RuntimeError("Failed to write pixel data to image file. No space left on device.")
    except RuntimeError as error:
        raise OSError("f.exr: cannot write the file") from error


@pytest.mark.parametrize(
    ("place", "error"),
    [("trainer.serving.upload._Raw.write", full_disk), ("trainer.serving.work.write_frame", full_disk),
     ("trainer.serving.work.write_frame", full_disk_by_openexr)],
)  # fmt: skip
def test_a_full_disk_is_the_servers_fault_and_passes(content, monkeypatch, place, error):
    gate = Gate()
    gate.opened.set()
    with Running(gate) as service:
        with monkeypatch.context() as patch:
            patch.setattr(place, error)
            refused = service.post(content)
        assert (refused.status_code, int(refused.headers["retry-after"])) == (503, 5)
        assert "no room" in refused.json()["detail"]
        assert service.post(content).status_code == 200
        wait_until(lambda: service.service.room.taken == 0)


def test_probes_are_answered_though_there_are_too_many_connections(content, monkeypatch):
    monkeypatch.setattr(serving, "_MORE_CONNECTIONS", 0)
    monkeypatch.setattr(serving, "_SPARE", 4)
    with ExitStack() as stack:
        service = stack.enter_context(Running(Gate(), limits(queue=0), most=1))  # eight connections
        open_ones = service.server.server_state.connections
        for _ in range(30):
            stack.enter_context(service.raw(b"POST /denoise HTTP/1.1\r\nHost: x\r\n"))
        wait_until(lambda: len(open_ones) == 12)
        assert service.client.get("/health").json()["status"] == "ok"
        refused = service.post(content)
        assert (refused.status_code, refused.headers["connection"]) == (503, "close")
        assert "too many connections" in refused.json()["detail"]
        assert len(open_ones) <= 12


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


def test_the_budget_lets_one_wait_until_another_is_done_or_its_time_is_up():
    budget = Budget(100)
    ticket, late = Ticket(time.monotonic() + 60), budget.hold(1, Ticket(time.monotonic() + 0.2))
    with budget.hold(70, ticket), budget.hold(30, ticket), pytest.raises(Over):
        late.__enter__()
    assert budget.held == 0


def test_a_service_whose_model_cannot_run_any_more_says_so_at_once(content, monkeypatch, caplog):
    gate = Gate()
    gate.opened.set()
    with Running(gate) as service:

        def broken(tiles, megapixels):
            raise RuntimeError("a bug")

        monkeypatch.setattr(service.service.batcher, "told", broken)
        for _ in range(2):  # the one whose tile it was, and one that comes later
            failed = service.post(content)
            assert failed.status_code == 503
            assert "cannot run its model" in failed.json()["detail"]
        answer = service.client.get("/health")
        assert (answer.status_code, answer.json()["status"]) == (503, "failed")
    assert "a bug" in caplog.text
