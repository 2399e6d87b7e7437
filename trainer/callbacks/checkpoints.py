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

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what is known of the run's checkpoints, also where its folder was moved.

        Lightning forgets the best score where the folder has another name; the next validation would then
        replace `best.ckpt` whatever its score.
        """
        before, now = str(state_dict.get("dirpath") or ""), str(self.dirpath or "")
        if before != now and Path(before).parts[-3:] == Path(now).parts[-3:]:  # EXPERIMENT/NAME/checkpoints
            state_dict = _moved(state_dict, before, now)
        super().load_state_dict(state_dict)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save where that is due: the weights after the step, which Lightning warns of without need."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Using ModelCheckpoint with manual optimization")
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)


def _moved(state: Any, before: str, now: str) -> Any:
    """Return a callback's state in which all paths below one folder are below another."""
    if isinstance(state, dict):
        return {_moved(key, before, now): _moved(value, before, now) for key, value in state.items()}
    if isinstance(state, str) and (state == before or state.startswith(f"{before}{os.sep}")):
        return now + state[len(before) :]
    return state


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

    Where a validation or the end of an epoch follows the step that is due, the step after them is saved: a
    run that continues from a checkpoint before them would leave out the validation, what callbacks do at the
    end of an epoch, and the numbers of both.

    Args:
        every_n_train_steps: Steps between two saves, 0 for one at the end; at most one more is lost when a
            run is killed.
    """

    def __init__(self, every_n_train_steps: int = 50) -> None:
        super().__init__(
            filename="last", every_n_train_steps=every_n_train_steps, save_top_k=1,
            enable_version_counter=False, auto_insert_metric_name=False,
        )  # fmt: skip
        self._postponed: int | None = None  # the step that was due

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save where that is due, or was before a validation or the end of an epoch."""
        if self._postponed is not None:
            if trainer.global_step > self._postponed:  # not within the batches of one accumulated step
                self._postponed = None
                self._save(trainer)
        elif self._due(trainer) and self._more_follows(trainer):
            self._postponed = trainer.global_step
        else:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the end of training, whatever the interval.

        Here, since callbacks that average weights put them in the place of those that would be trained on
        when training has ended.
        """
        super().on_train_epoch_end(trainer, pl_module)
        if trainer.fit_loop.done:
            self.on_train_end(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the end of training where no epoch ended with it."""
        super().on_train_end(trainer, pl_module)
        if self._last_global_step_saved != trainer.global_step:
            self._save(trainer)

    def _due(self, trainer: Trainer) -> bool:
        steps = self._every_n_train_steps
        return (
            steps > 0
            and trainer.global_step % steps == 0
            and not self._should_skip_saving_checkpoint(trainer)
        )

    def _more_follows(self, trainer: Trainer) -> bool:
        """Return whether a validation or the end of an epoch comes before the next step."""
        loop, fetcher = trainer.fit_loop.epoch_loop, trainer.fit_loop._data_fetcher
        return loop._num_ready_batches_reached() or loop._should_check_val_fx(fetcher)  # type: ignore[arg-type]

    def _save(self, trainer: Trainer) -> None:
        self._save_checkpoint(trainer, os.path.join(self.dirpath or ".", "last.ckpt"))
