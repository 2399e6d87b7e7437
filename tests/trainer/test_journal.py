"""The journal of a run: torn lines, a full disk, clocks, files."""

import errno
import json
import os
import time

import pytest

from trainer.spool import journal as module
from trainer.spool.journal import Clock, Journal, events
from trainer.spool.recorded import Recorded


def metrics(step, **values):
    return {"type": "metrics", "step": step, "values": values}


def steps(folder):
    return [event["step"] for event, _ in events(folder)]


def test_events_are_on_the_disk_in_order_when_append_returns(tmp_path):
    journal = Journal(tmp_path)
    for step in range(5):
        journal.append(metrics(step, loss=1.0))
        assert steps(tmp_path) == list(range(step + 1))


def test_reading_goes_on_where_it_stopped(tmp_path):
    journal = Journal(tmp_path)
    for step in range(4):
        journal.append(metrics(step))
    offsets = [offset for _, offset in events(tmp_path)]
    assert [event["step"] for event, _ in events(tmp_path, offsets[1])] == [2, 3]
    assert list(events(tmp_path, offsets[-1])) == []


@pytest.mark.parametrize("cut", [1, 10, 30])
def test_line_that_a_kill_has_torn_is_skipped_and_the_next_ones_are_whole(tmp_path, cut):
    journal = Journal(tmp_path)
    journal.append(metrics(0))
    journal.append(metrics(1))
    text = journal.path.read_bytes()
    journal.path.write_bytes(text[:-cut])
    assert steps(tmp_path) == [0]
    again = Journal(tmp_path)
    again.append(metrics(2))
    assert steps(tmp_path)[-1] == 2
    assert len(journal.path.read_bytes().splitlines()) == 3


def test_damaged_lines_are_skipped(tmp_path):
    journal = Journal(tmp_path)
    journal.append(metrics(0))
    with journal.path.open("ab") as file:
        file.write(b"\x00\xff{]\n[1]\n{}\n\n")
    journal.append(metrics(1))
    assert steps(tmp_path) == [0, 1]


class Disk:
    """Stands in for `os.write`: takes so many bytes, then says that it is full."""

    def __init__(self, monkeypatch, space):
        self.space = space
        self._write = os.write
        monkeypatch.setattr(module.os, "write", self)

    def __call__(self, file, data):
        if self.space <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self._write(file, data[: self.space])
        self.space -= written
        return written


@pytest.mark.parametrize("space", [0, 1, 40, 75, 76, 77, 100])
def test_full_disk_keeps_events_in_memory_and_writes_them_when_there_is_space(
    tmp_path, monkeypatch, capsys, space
):
    disk = Disk(monkeypatch, space)
    journal = Journal(tmp_path)
    for step in range(6):
        journal.append(metrics(step, loss=1.0))
    assert not journal.flush()
    disk.space = 1 << 20
    journal.append(metrics(6, loss=1.0))
    assert sorted(set(steps(tmp_path))) == list(range(7))
    found = [json.dumps(event) for event, _ in events(tmp_path)]
    assert len(dict.fromkeys(found)) == 7, "an event that was written twice is the same to the store"
    said = capsys.readouterr().err
    assert said.count("The disk is full") == said.count("There is space again") == 1


def test_another_error_of_the_disk_is_one_line_that_names_the_journal(tmp_path, monkeypatch):
    def broken(file, data):
        raise OSError(errno.EIO, "Input/output error")

    journal = Journal(tmp_path)
    monkeypatch.setattr(module.os, "write", broken)
    with pytest.raises(OSError, match=r"cannot write .*journal.jsonl: Input/output error"):
        journal.append(metrics(0))


def test_clock_follows_time_and_never_goes_back(monkeypatch):
    clock = Clock()
    first = clock()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert first <= clock() < first + 60_000
    assert Clock(after=first)() > first
    monkeypatch.setattr(time, "time", lambda: 4e9)
    assert Clock(after=first)() >= 4_000_000_000_000


def test_file_is_kept_as_it_was_when_it_was_recorded(tmp_path):
    journal = Journal(tmp_path / "run")
    path = tmp_path / "best.ckpt"
    path.write_bytes(b"one")
    kept = journal.keep(path)
    later = tmp_path / "later"
    later.write_bytes(b"two")
    os.replace(later, path)  # as checkpoints and exports are written
    assert (journal.folder / kept["file"]).read_bytes() == b"one"
    assert journal.keep(path)["sha256"] != kept["sha256"]


def test_file_on_a_disk_without_links_is_copied(tmp_path, monkeypatch):
    def no_links(source, target):
        raise OSError(errno.EPERM, "no links")

    monkeypatch.setattr(module.os, "link", no_links)
    journal = Journal(tmp_path / "run")
    path = tmp_path / "model.onnx"
    path.write_bytes(b"x")
    assert (journal.folder / journal.keep(path)["file"]).read_bytes() == b"x"


def test_what_is_recorded_is_known_after_a_restart(tmp_path):
    journal = Journal(tmp_path)
    journal.append({"type": "run", "id": "abc"})
    journal.append({"type": "status", "status": "RUNNING"})
    journal.append(metrics(3, loss="nan", psnr=2.0))
    journal.append({"type": "params", "values": {"lr": "1"}})
    journal.append({"type": "params", "values": {"lr": "2"}})
    journal.append({"type": "file", "to": "a.txt", "sha256": "1", "file": "f"})
    known = Recorded.of(tmp_path)
    assert (known.id, known.trained, known.params) == ("abc", True, {"lr": "1"})
    assert known.has_value("loss", 3)
    assert not known.has_value("loss", 4)
    assert known.has_equal("loss", 3, float("nan"))
    assert not known.has_equal("psnr", 3, 3.0)
    assert known.has({"type": "file", "to": "a.txt", "sha256": "1"})
    assert not known.has({"type": "file", "to": "a.txt", "sha256": "2"})
    assert known.next_step("") == 4
    assert known.last_ms > 0
