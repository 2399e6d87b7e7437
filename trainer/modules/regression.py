"""Supervised training of a denoiser with one loss and one optimiser."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from models.denoiser import Denoiser
from trainer.losses import SMAPE
from trainer.modules.evaluation import Batch, Evaluated
from trainer.schedules import MakeOptimizer, MakeSchedule, scheduled


class Regression(Evaluated):
    """Minimise a loss between denoised and reference radiance.

    Loss and metrics see exposed radiance: radiance times the frame's `exposure`, so that scenes in different
    units weigh alike. The network's output stays in the units of its input.

    Args:
        net: The denoiser to train.
        loss: Module called with exposed output and target (B, 3, H, W).
        optimizer: Makes the optimiser from the parameters; a class path in a configuration.
        lr_scheduler: Makes a learning-rate schedule: `trainer.schedules.OneCycle` is stepped after every
            step, the schedules of PyTorch after every epoch; none by default.
    """

    def __init__(
        self,
        net: Denoiser,
        loss: nn.Module | None = None,
        optimizer: MakeOptimizer = torch.optim.Adam,
        lr_scheduler: MakeSchedule | None = None,
    ) -> None:
        super().__init__(net)
        self.keep_arguments()
        self.loss = loss if loss is not None else SMAPE()
        self.make_optimizer = optimizer
        self.make_lr_scheduler = lr_scheduler

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch."""
        output, target = self.exposed(batch)
        loss: Tensor = self.loss(output, target)
        self.log("train/loss", loss, on_step=True, on_epoch=True, batch_size=len(target))
        return loss

    def validation_loss(self, batch: Batch, output: Tensor, target: Tensor) -> Tensor:
        """Return the loss of exposed output and reference."""
        loss: Tensor = self.loss(output, target)
        return loss

    def configure_optimizers(self) -> dict[str, Any]:  # type: ignore[override]
        """Return the optimiser, with its schedule if there is one."""
        optimizer = self.make_optimizer(self.net.parameters())
        steps = self.trainer.estimated_stepping_batches
        return scheduled(optimizer, self.make_lr_scheduler, steps, "Regression")
