"""All ranks of an attempt agree on a name, whatever earlier attempts left in the store."""

import threading
from datetime import timedelta
from types import SimpleNamespace

import pytest
import torch.distributed as dist
from lightning.pytorch.loops.training_epoch_loop import _TrainingEpochLoop
from lightning.pytorch.utilities.exceptions import SIGTERMException

from trainer.callbacks.same_start import SameStart
from trainer.elastic import agree, heed_failures


def attempt(store, ranks, world, patience=timedelta(seconds=20)):
    """Let some ranks of a world meet; returns the name that each got, or its error."""
    names = {}

    def run(rank):
        try:
            names[rank] = agree(store, rank, world, patience)
        except TimeoutError as error:
            names[rank] = error

    threads = [threading.Thread(target=run, args=(rank,)) for rank in ranks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return names


@pytest.fixture
def store():
    return dist.HashStore()


def test_all_ranks_get_one_name(store):
    names = attempt(store, range(4), 4)
    assert len(names) == 4
    assert len(set(names.values())) == 1


def test_every_attempt_has_a_name_of_its_own(store):
    assert len({attempt(store, range(3), 3)[0] for _ in range(5)}) == 5


def test_words_of_ranks_that_were_killed_while_they_asked_do_no_harm(store):
    attempt(store, [1, 2], 3, timedelta(seconds=0.2))
    names = attempt(store, range(3), 3)
    assert isinstance(names[0], str)
    assert len(set(names.values())) == 1


def test_rank_that_does_not_start_is_named(store):
    names = attempt(store, [0, 2], 3, timedelta(seconds=0.2))
    assert "ranks 1 of 3 did not start" in str(names[0])


def test_rank_whose_first_rank_does_not_start_says_so(store):
    names = attempt(store, [1], 2, timedelta(seconds=0.2))
    assert "rank 1 waited" in str(names[1])


@pytest.mark.parametrize(
    ("steps", "told"),
    [
        ([7, 7, 7], None),
        ([7, 0, 7], "rank 1 at step 0, ranks 0, 2 at step 7"),
        ([0] * 5 + [9], "0, 1, 2, 3 …"),
    ],
)
def test_ranks_that_begin_from_different_steps_are_refused(monkeypatch, steps, told):
    def gather(gathered, mine):
        assert mine == steps[0]
        gathered[:] = steps

    monkeypatch.setattr(dist, "all_gather_object", gather)
    trainer = SimpleNamespace(world_size=len(steps), global_step=steps[0])
    if told is None:
        SameStart().on_train_start(trainer, None)
        return
    with pytest.raises(ValueError, match="different checkpoints") as refused:
        SameStart().on_train_start(trainer, None)
    assert told in str(refused.value)


@pytest.fixture
def told(monkeypatch):
    """A trainer of two ranks whose loop tells of SIGTERM as ours do, and what that told."""
    heard = []

    def broadcast(tensor, src):
        heard.append(int(tensor))

    monkeypatch.setattr(dist, "broadcast", broadcast)
    monkeypatch.setattr(dist, "barrier", lambda: None)
    loop = SimpleNamespace(epoch_loop=SimpleNamespace())
    strategy = SimpleNamespace(root_device="cpu")
    trainer = SimpleNamespace(world_size=2, fit_loop=loop, strategy=strategy, received_sigterm=False)
    heed_failures(trainer)
    return trainer, heard


def test_ranks_tell_each_other_of_sigterm_before_each_batch(told):
    trainer, heard = told
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor()
    trainer.received_sigterm = True
    with pytest.raises(SIGTERMException):
        trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor()
    assert heard == [0, 1]


def test_death_of_a_reader_while_ranks_tell_each_other_of_sigterm_is_not_passed_over(told, monkeypatch):
    def fails(tensor, src):
        raise RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed.")

    monkeypatch.setattr(dist, "broadcast", fails)
    with pytest.raises(RuntimeError, match="DataLoader worker"):
        told[0].fit_loop.epoch_loop._broadcast_sigterm_tensor()


def test_lightning_has_what_is_replaced():
    assert "_broadcast_sigterm_tensor" in vars(_TrainingEpochLoop)
