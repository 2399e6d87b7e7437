"""A run that ends badly and goes on has recorded every step once: no checkpoint is ahead of the journal."""

import warnings

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping
from torch.utils.data import DataLoader

from tests.trainer.test_journal import Disk
from trainer.callbacks.checkpoints import AtomicCheckpointIO, BestCheckpoint, LastCheckpoint
from trainer.callbacks.recorder import RunRecorder
from trainer.spool.journal import events
from trainer.tracking import MLflowTracking

pytestmark = pytest.mark.usefixtures("workplace", "quick_sending", "quiet_training")


class Line(LightningModule):
    """The smallest module that logs every step and every validation."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, batch_idx):
        loss = self.layer(batch["x"]).square().mean()
        self.log("loss", loss)
        return loss

    def validation_step(self, batch, batch_idx):
        self.log("val/loss", self.layer(batch["x"]).square().mean())

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


class Recorder(RunRecorder):
    """Describes no configuration, since there is none."""

    def __init__(self):
        super().__init__(None, None, save_to_log_dir=False)

    def save_config(self, trainer, pl_module, stage):
        pass


class KilledError(BaseException):
    """Stands in for SIGKILL."""


class Saving(AtomicCheckpointIO):
    """Does something when a checkpoint is saved at a step."""

    def __init__(self, step=None, before=lambda: None, after=lambda: None):
        self.step, self.before, self.after = step, before, after

    def save_checkpoint(self, checkpoint, path, storage_options=None):
        here = checkpoint["global_step"] == self.step
        if here:
            self.before()
        super().save_checkpoint(checkpoint, path, storage_options)
        if here:
            self.after()


def train(resume=None, saving=None, callbacks=(), validation=True, every=2, **options):
    """Train two epochs of four steps, with a checkpoint every second step; returns the trainer."""
    log = MLflowTracking("exp", system_metrics=False, resume_from=resume and str(resume))
    trainer = Trainer(
        max_epochs=2, logger=log, log_every_n_steps=1, plugins=[saving or Saving()], accelerator="cpu",
        callbacks=[Recorder(), *callbacks, LastCheckpoint(every)], enable_model_summary=False,
        enable_progress_bar=False, **options,
    )  # fmt: skip
    batches = DataLoader([{"x": torch.ones(1)}] * 4)
    ckpt = str(resume / "checkpoints" / "last.ckpt") if resume else None
    trainer.fit(Line(), batches, batches if validation else [], ckpt_path=ckpt)
    return trainer


def folder_of(workplace):
    return next(workplace.glob("runs/exp/*/run.json")).parent


class Saves(Callback):
    """Notes the steps at which the last checkpoint was saved."""

    def __init__(self):
        self.steps = []

    def on_save_checkpoint(self, trainer, pl_module, checkpoint):
        self.steps.append(trainer.global_step)


def logged(folder):
    found = {}
    for event, _ in events(folder):
        if event["type"] == "metrics":
            for key in event["values"]:
                found.setdefault(key, []).append(event["step"])
    return found


def killed():
    raise KilledError


@pytest.fixture
def quiet_training():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The 'train_dataloader' does not have many workers")
        warnings.filterwarnings("ignore", "The 'val_dataloader' does not have many workers")
        warnings.filterwarnings(
            "ignore", "You're resuming from a checkpoint that ended before the epoch ended"
        )
        warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
        warnings.filterwarnings("ignore", "Total length of `list` across ranks is zero")
        yield


@pytest.mark.parametrize("step", [2, 5, 6, 8])
def test_run_that_is_killed_as_soon_as_a_checkpoint_is_saved_ends_with_every_step_once(step, workplace):
    with pytest.raises(KilledError):
        train(saving=Saving(step, after=killed))
    folder = folder_of(workplace)
    train(resume=folder)
    assert logged(folder) == {"loss": list(range(8)), "epoch": list(range(8)), "val/loss": [3, 7]}


@pytest.mark.parametrize("room_for_checkpoint", [False, True])
def test_run_on_a_full_disk_ends_with_a_message_and_continues_without_a_gap(
    room_for_checkpoint, workplace, monkeypatch, capsys
):
    disk = Disk(monkeypatch, 1 << 20)

    def fill():
        disk.space = 0

    saving = Saving(2, after=fill) if room_for_checkpoint else Saving(5, before=fill, after=killed)
    with pytest.raises((OSError, KilledError)) as stopped:
        train(saving=saving)
    folder = folder_of(workplace)
    if room_for_checkpoint:
        assert "the disk is full; continue with --ckpt_path last" in str(stopped.value)
        assert "events of" in capsys.readouterr().err
    disk.space = 1 << 20
    train(resume=folder)
    assert logged(folder)["loss"] == list(range(8))


@pytest.mark.parametrize(
    ("options", "steps"),
    [
        ({}, [2, 5, 6, 8]),  # 4 is before a validation, and the end of an epoch; 8 is the end of training
        ({"validation": False}, [2, 5, 6, 8]),
        ({"check_val_every_n_epoch": 2}, [2, 5, 6, 8]),
        ({"val_check_interval": 2}, [3, 5, 7, 8]),  # all that are due are before validations
        ({"every": 4}, [5, 8]),
        ({"every": 1}, [1, 2, 3, 5, 6, 7, 8]),
        ({"every": 0}, [8]),
        ({"accumulate_grad_batches": 2, "every": 1}, [1, 3, 4]),
    ],
)
def test_what_follows_a_step_is_done_before_a_checkpoint_is_saved(options, steps, workplace):
    saves = Saves()
    train(callbacks=[saves], **options)
    assert saves.steps == steps


def test_a_run_that_is_killed_keeps_the_best_score_of_all_epochs(workplace):
    best = BestCheckpoint("val/loss", "min")
    with pytest.raises(KilledError):
        train(saving=Saving(5, after=killed), callbacks=[best])
    folder = folder_of(workplace)
    again = BestCheckpoint("val/loss", "min")
    seen = []

    class Look(Callback):
        def on_train_start(self, trainer, pl_module):
            seen.append((again.best_model_score, again.best_model_path))

    train(resume=folder, callbacks=[again, Look()])
    assert seen == [(best.best_model_score, str((folder / "checkpoints" / "best.ckpt").resolve()))]
    assert again.best_model_score < best.best_model_score  # the second epoch was better


def test_a_run_whose_folder_was_moved_keeps_its_best_score(workplace, tmp_path, monkeypatch):
    with pytest.raises(KilledError):
        train(saving=Saving(6, after=killed), callbacks=[BestCheckpoint("val/loss", "max")])
    (tmp_path / "elsewhere").mkdir()
    (workplace / "runs").rename(tmp_path / "elsewhere" / "runs")
    monkeypatch.chdir(tmp_path / "elsewhere")
    best = BestCheckpoint("val/loss", "max")
    folder = folder_of(tmp_path / "elsewhere")
    first = (folder / "checkpoints" / "best.ckpt").read_bytes()
    train(resume=folder, callbacks=[best])
    assert (
        folder / "checkpoints" / "best.ckpt"
    ).read_bytes() == first  # the loss only fell: the first was best
    assert best.best_model_path == str(folder / "checkpoints" / "best.ckpt")


@pytest.mark.parametrize("step", [2, 5, 6])
def test_a_run_that_may_stop_early_continues(step, workplace):
    def stopping():
        return EarlyStopping("val/loss", patience=5)

    with pytest.raises(KilledError):
        train(saving=Saving(step, after=killed), callbacks=[stopping()])
    trainer = train(resume=folder_of(workplace), callbacks=[stopping()])
    assert trainer.global_step == 8
