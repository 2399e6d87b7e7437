"""Checkpoints of a run: the best by validation, and the last at short intervals."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from trainer.tracking import MLflowTracking


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints beside their final name and renames them.

    A process that is killed while saving leaves the previous checkpoint whole. (Lightning's own writer
    moves the file from the system's temporary folder, which is a copy when that is another disk.)
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint whole or not at all.

        Raises:
            OSError: The disk is full or the folder cannot be written; names the file.
        """
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.{os.getpid()}.tmp")
        try:
            torch.save(checkpoint, partial)
            os.replace(partial, target)
        except (OSError, RuntimeError) as error:  # torch reports a full disk as RuntimeError
            raise OSError(f"cannot write checkpoint {target}: {error}") from error
        finally:
            partial.unlink(missing_ok=True)


class _RunCheckpoint(ModelCheckpoint):
    """A checkpoint callback that writes into the run's folder."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Take the first rank's run folder on every rank."""
        if self.dirpath is None and isinstance(trainer.logger, MLflowTracking):
            self.dirpath = str(trainer.logger.share_folder(trainer.strategy.broadcast) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save where that is due: the weights after the step, which Lightning warns of without need."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Using ModelCheckpoint with manual optimization")
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)


class BestCheckpoint(_RunCheckpoint):
    """Keeps `checkpoints/best.ckpt`, the weights with the best validation score.

    Args:
        monitor: Logged number to watch.
        mode: `max` or `min`.
    """

    def __init__(self, monitor: str = "val/psnr_wskp", mode: str = "max") -> None:
        super().__init__(
            filename="best", monitor=monitor, mode=mode, save_top_k=1, enable_version_counter=False,
            auto_insert_metric_name=False,
        )  # fmt: skip


class LastCheckpoint(_RunCheckpoint):
    """Keeps `checkpoints/last.ckpt`, from which a killed run continues.

    Args:
        every_n_train_steps: Steps between two saves; at most so many are lost when a run is killed.
    """

    def __init__(self, every_n_train_steps: int = 50) -> None:
        super().__init__(
            filename="last", every_n_train_steps=every_n_train_steps, save_top_k=1,
            enable_version_counter=False, auto_insert_metric_name=False,
        )  # fmt: skip

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save where that is due, unless a validation follows.

        A run that continues from a checkpoint before a validation would leave the validation out.
        """
        if not trainer.fit_loop.epoch_loop._should_check_val_fx(trainer.fit_loop._data_fetcher):  # type: ignore[arg-type]
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save what was due before the validation."""
        super().on_validation_end(trainer, pl_module)
        due = trainer.global_step % self._every_n_train_steps == 0
        if due and not self._should_skip_saving_checkpoint(trainer):
            self._save(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the end of training, whatever the interval."""
        super().on_train_end(trainer, pl_module)
        if self._last_global_step_saved != trainer.global_step:
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        self._save_checkpoint(trainer, os.path.join(self.dirpath or ".", "last.ckpt"))
