"""A run that ends badly and goes on has recorded every step once: no checkpoint is ahead of the journal."""

import warnings

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader

from tests.trainer.test_journal import Disk
from trainer.callbacks.checkpoints import AtomicCheckpointIO, LastCheckpoint
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


def train(resume=None, saving=None):
    """Train two epochs of four steps, with a checkpoint every second step; returns the tracking."""
    log = MLflowTracking("exp", system_metrics=False, resume_from=resume and str(resume))
    trainer = Trainer(
        max_epochs=2, logger=log, log_every_n_steps=1, callbacks=[Recorder(), LastCheckpoint(2)],
        plugins=[saving or Saving()], accelerator="cpu", enable_model_summary=False,
        enable_progress_bar=False,
    )  # fmt: skip
    batches = DataLoader([{"x": torch.ones(1)}] * 4)
    ckpt = str(resume / "checkpoints" / "last.ckpt") if resume else None
    trainer.fit(Line(), batches, batches, ckpt_path=ckpt)
    return log


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
        yield


@pytest.mark.parametrize("step", [2, 4, 6, 8])
def test_run_that_is_killed_as_soon_as_a_checkpoint_is_saved_ends_with_every_step_once(step, workplace):
    with pytest.raises(KilledError):
        train(saving=Saving(step, after=killed))
    folder = next(workplace.glob("runs/exp/*/run.json")).parent
    train(resume=folder)
    assert logged(folder) == {"loss": list(range(8)), "epoch": list(range(8)), "val/loss": [3, 7]}


@pytest.mark.parametrize("room_for_checkpoint", [False, True])
def test_run_on_a_full_disk_ends_with_a_message_and_continues_without_a_gap(
    room_for_checkpoint, workplace, monkeypatch, capsys
):
    disk = Disk(monkeypatch, 1 << 20)

    def fill():
        disk.space = 0

    saving = Saving(2, after=fill) if room_for_checkpoint else Saving(4, before=fill, after=killed)
    with pytest.raises((OSError, KilledError)) as stopped:
        train(saving=saving)
    folder = next(workplace.glob("runs/exp/*/run.json")).parent
    if room_for_checkpoint:
        assert "the disk is full; continue with --ckpt_path last" in str(stopped.value)
        assert "events of" in capsys.readouterr().err
    disk.space = 1 << 20
    train(resume=folder)
    assert logged(folder)["loss"] == list(range(8))
