"""Tells a health check that batches go on, those of validations included."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from data.alive import touch


class Alive(Callback):
    """Touches the file that `$PENUMBRA_ALIVE` names after each batch; set where that variable is."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, *args: Any, **more: Any
    ) -> None:
        """Touch it."""
        touch()

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, *args: Any, **more: Any
    ) -> None:
        """Touch it."""
        touch()

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, *args: Any, **more: Any
    ) -> None:
        """Touch it."""
        touch()
