"""The processes that decode: what they may take, and how they are replaced."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.trainer.serving.running import Gate, Running, exr, limits
from trainer.serving import readers as module
from trainer.serving.limits import Over, Refusal, Ticket
from trainer.serving.readers import Readers
from trainer.serving.room import is_full
from trainer.serving.wire import Parcel


class FullDisk:
    """Stands for a process that could not unpack a file."""

    def ask(self, request, ticket):
        return Parcel({"error": "[Errno 28] No space left on device", "full": True})


def test_a_full_disk_of_a_reader_is_told_from_a_damaged_file():
    assert is_full(OSError(errno.ENOSPC, "x"))
    assert not is_full(OSError(errno.EIO, "x"))
    assert not is_full(ValueError("damaged"))
    readers = Readers(1, limits())
    try:
        readers._idle.get()
        readers._idle.put(FullDisk())
        with pytest.raises(Refusal) as refused:
            readers.room(Path(), "f.zip", Ticket(time.monotonic() + 60))
        assert refused.value.status == 503
    finally:
        readers.close()


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


def test_a_client_that_goes_away_is_no_death_of_a_reader(tmp_path):
    exr(tmp_path)
    readers = Readers(1, limits())
    ticket = Ticket(time.monotonic() + 60)
    try:
        before = next(iter(readers._all))
        os.kill(before._process.pid, signal.SIGSTOP)
        threading.Timer(0.2, ticket.cancel).start()
        with pytest.raises(Over):
            readers.frames(tmp_path, "f0.exr", ticket)
        assert before not in readers._all
        assert readers.deaths == 0
    finally:
        readers.close()


def test_a_reader_that_hangs_is_replaced(tmp_path):
    exr(tmp_path)
    readers = Readers(1, limits(decode=0.3))
    ticket = Ticket(time.monotonic() + 60)
    try:
        process = next(iter(readers._all))
        process._begin(ticket)
        os.kill(process._process.pid, signal.SIGSTOP)
        with pytest.raises(Refusal, match="could not be decoded within"):
            readers.frames(tmp_path, "f0.exr", ticket)
        assert readers.deaths == 1
    finally:
        readers.close()


@pytest.mark.parametrize("command", [["false"], ["sleep", "60"], ["no/such/program"]])
def test_a_reader_that_does_not_start_is_no_fault_of_the_file(tmp_path, monkeypatch, command):
    exr(tmp_path)
    monkeypatch.setattr(module, "command", lambda: command)
    monkeypatch.setattr(module, "START_S", 0.5)
    readers = Readers(1, limits())
    ticket = Ticket(time.monotonic() + 60)
    try:
        for _ in range(2):
            with pytest.raises(Refusal, match="does not start") as refused:
                readers.frames(tmp_path, "f0.exr", ticket)
            assert refused.value.status == 503
        monkeypatch.undo()
        with contextlib.suppress(Refusal):  # the one that was started before
            readers.frames(tmp_path, "f0.exr", ticket)
        assert readers.frames(tmp_path, "f0.exr", ticket)[0]["name"] == "f0.exr"
    finally:
        readers.close()
