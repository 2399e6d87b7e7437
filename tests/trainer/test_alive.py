"""A file that a health check looks at is touched by every kind of work that takes long."""

from __future__ import annotations

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.demos.boring_classes import BoringModel

from data import alive
from data.progress import LineProgress
from trainer.callbacks.alive import Alive
from trainer.progress import sample_progress


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv(alive.ALIVE, str(tmp_path / "alive"))
    monkeypatch.setattr(alive, "INTERVAL_S", 0.0)
    return tmp_path / "alive"


class Looking(BoringModel):
    """Removes the file in each step and counts how often the one before had left it."""

    def __init__(self, file):
        super().__init__()
        self.file, self.found = file, {"train": 0, "validation": 0, "test": 0}

    def _look(self, kind):
        self.found[kind] += self.file.exists()
        self.file.unlink(missing_ok=True)

    def training_step(self, batch, batch_idx):
        self._look("train")
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch, batch_idx):
        self._look("validation")
        return super().validation_step(batch, batch_idx)

    def test_step(self, batch, batch_idx):
        self._look("test")
        return super().test_step(batch, batch_idx)


@pytest.mark.filterwarnings("ignore")  # Lightning's advice
def test_every_batch_of_training_validation_and_test_touches_the_file(file, tmp_path):
    trainer = Trainer(
        default_root_dir=tmp_path, max_epochs=1,
        limit_train_batches=3, limit_val_batches=3, limit_test_batches=3,
        num_sanity_val_steps=0, logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, accelerator="cpu", callbacks=[Alive()],
    )  # fmt: skip
    model = Looking(file)
    trainer.fit(model)
    trainer.test(model, verbose=False)
    assert model.found == {"train": 2, "validation": 3, "test": 3}
    assert file.exists()


def test_preparing_and_rendering_touch_the_file(file, capsys):
    LineProgress("preparing")(1, 10)
    assert file.exists()
    file.unlink()
    with sample_progress("rendering") as progress:
        progress(1, 10, "scene")
    assert file.exists()


def test_without_the_variable_or_where_it_cannot_be_written_nothing_happens(file, monkeypatch, tmp_path):
    monkeypatch.setenv(alive.ALIVE, str(tmp_path / "absent" / "alive"))
    alive.touch()
    monkeypatch.delenv(alive.ALIVE)
    alive.touch()
    assert not list(tmp_path.iterdir())
