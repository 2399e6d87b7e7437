"""A run and its mirror agree whenever the node dies, and the tracking store has only what the mirror has."""

import time
from types import SimpleNamespace

import pytest

from tests.trainer.cluster.test_storage import save
from trainer.callbacks import MirrorRun
from trainer.cluster import storage as module
from trainer.cluster.restoring import reached
from trainer.cluster.storage import JOURNAL, fetch_run, storage_url
from trainer.runs import Launch, RunRecord, begin_launch, end_launch
from trainer.spool.delivery import Delivery
from trainer.spool.journal import Journal, events
from trainer.spool.sent import Sent
from trainer.tracking import MLflowTracking


class TrainingRun:
    """A run that goes on whenever its mirror copies a file: a step, its numbers, a checkpoint, a delivery."""

    def __init__(self, root):
        self.folder = root / "exp" / "20260101-000000"
        RunRecord("exp", self.folder.name, "sqlite:///x.db", "id").save(self.folder)
        begin_launch(self.folder, Launch("one"))
        self.journal, self.step, self.delivered = Journal(self.folder), 0, []
        self.delivery = Delivery(self.folder)
        self.delivery.sent = Sent("id")
        self.deliver_up_to(0)

    def deliver_up_to(self, offset):
        self.delivery.limit = offset

    def go_on(self):
        self.step += 1
        self.journal.append({"type": "metrics", "step": self.step, "values": {"loss": 1.0}})
        kept = self.journal.keep_bytes(str(self.step).encode(), "text.txt")
        self.journal.append({"type": "file", "to": f"{self.step}.txt", **kept})
        save(self.folder, self.step)
        while group := self.delivery._next():
            self.delivered += [event for event, _ in group]
            self.delivery.sent.offset = group[-1][1]
            self.delivery.sent.save(self.folder)


@pytest.fixture
def training(tmp_path, monkeypatch):
    run, hold = TrainingRun(tmp_path / "here"), module._hold

    def holding(*paths):
        run.go_on()
        return hold(*paths)

    monkeypatch.setattr(module, "_hold", holding)
    return run


@pytest.mark.parametrize("count", range(1, 60, 4))
def test_mirror_of_a_node_that_dies_after_any_file_has_all_that_was_delivered_and_that_it_claims(
    tmp_path, training, monkeypatch, count
):
    send, left = module.send, count

    def sending(path, url):
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError("the node is gone")
        send(path, url)

    monkeypatch.setattr(module, "send", sending)
    mirror = MirrorRun(str(tmp_path / "shared"))
    mirror._logger, mirror._folder = training, training.folder
    training.go_on()
    while left > 0:
        mirror._pass(journals=True)
    place = fetch_run(str(tmp_path / "shared"), "one", tmp_path / "there")
    if place is None:
        assert not training.delivered
        return
    has = [event for event, _ in events(place)]
    assert not [event for event in training.delivered if event not in has]
    assert Sent.load(place).offset <= (place / JOURNAL).stat().st_size
    steps = [event["step"] for event in has if event["type"] == "metrics"]
    _, last = reached(place)
    assert steps[:last] == list(range(1, last + 1))
    assert all((place / "spool" / event["file"]).is_file() for event in has if event["type"] == "file")


def test_numbers_are_delivered_as_soon_as_they_are_mirrored(tmp_path, training):
    mirror = MirrorRun(str(tmp_path / "shared"))
    mirror._logger, mirror._folder = training, training.folder
    training.go_on()
    assert not training.delivered
    mirror._pass(journals=True)
    training.go_on()
    assert next(event["step"] for event in training.delivered if event["type"] == "metrics") == 1


@pytest.fixture
def tracked(tmp_path, monkeypatch):
    """A run on a local store, and what a callback sees of its trainer."""
    monkeypatch.chdir(tmp_path)
    logger = MLflowTracking("exp", root="runs", system_metrics=False)
    begin_launch(logger.folder, Launch("one"))
    return logger, SimpleNamespace(logger=logger, is_global_zero=True)


def test_mirror_has_the_end_of_a_run(tmp_path, tracked):
    logger, trainer = tracked
    mirror = MirrorRun(str(tmp_path / "shared"))
    mirror.setup(trainer, None, "fit")
    logger.log_metrics({"loss": 1.0}, 1)
    mirror.teardown(trainer, None, "fit")
    logger.finalize("success")
    end_launch(logger.folder)
    mirror.finish()
    place = tmp_path / "shared" / "exp" / logger.folder.name
    assert [event["status"] for event, _ in events(place) if event["type"] == "status"][-1] == "FINISHED"
    assert Sent.load(place).offset == (place / JOURNAL).stat().st_size
    assert RunRecord.load(place).run_id == logger.run_id
    assert (
        fetch_run(str(tmp_path / "shared"), "one", tmp_path / "there") is None
    )  # there is nothing left to do


def test_end_that_could_not_be_mirrored_is_told_and_kept_from_the_store_no_longer(tmp_path, tracked, capsys):
    logger, trainer = tracked
    RunRecord("exp", logger.folder.name).save(logger.folder)
    (tmp_path / "file").write_text("")
    mirror = MirrorRun(str(tmp_path / "file" / "below"))
    mirror.setup(trainer, None, "fit")
    assert logger._limit == 0
    while not mirror._trouble:
        time.sleep(0.01)
    mirror.teardown(trainer, None, "fit")
    assert logger._limit is None
    mirror.finish()
    said = capsys.readouterr().err
    assert said.count("The run is not mirrored") == 1
    assert f"warning: the end of the run is not in {storage_url(str(tmp_path / 'file' / 'below'))}" in said
