"""Stops training at the first loss or gradient that is not a number, with the batch that caused it."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from trainer.divergence import diverged
from trainer.tracking import MLflowTracking


class FiniteGuard(Callback):
    """Raise before a step whose loss or gradient is NaN or infinite; save the batch beside the run.

    The weights are those before the step. A module that optimises by hand watches over itself, as
    `trainer.modules.Adversarial` does, and has its loss checked after the step.
    """

    def __init__(self) -> None:
        self._batch: dict[str, Any] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Learn the run's folder while all ranks still work together."""
        if stage == "fit" and isinstance(trainer.logger, MLflowTracking):
            trainer.logger.share_folder(trainer.strategy.broadcast)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Remember the batch."""
        self._batch = batch

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        """Check the loss.

        Raises:
            ValueError: Names the step, the file that holds the batch and buffers that are not finite.
        """
        if pl_module.automatic_optimization:
            self._check(pl_module, loss, "the loss")

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Check the gradient, unless the precision skips steps of which it is infinite itself.

        Raises:
            ValueError: As for the loss.
        """
        plugin = trainer.precision_plugin
        scaled = isinstance(plugin, MixedPrecision) and plugin.scaler is not None
        if pl_module.automatic_optimization and not scaled:
            gradients = [p.grad for group in optimizer.param_groups for p in group["params"]]
            norm = get_total_norm([g for g in gradients if g is not None])
            self._check(pl_module, norm, "the gradient's norm")

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Check the loss of a module that optimises by hand, and forget the batch.

        Raises:
            ValueError: As for the loss.
        """
        loss = outputs.get("loss") if isinstance(outputs, dict) else outputs
        if loss is not None and not pl_module.automatic_optimization:
            self._check(pl_module, loss, "the loss", taken=1)
        self._batch = {}

    def _check(self, module: LightningModule, value: Tensor, name: str, taken: int = 0) -> None:
        if not bool(torch.isfinite(value).all()):
            raise diverged(module, self._batch, f"{name} became {float(value.detach())}", taken)
