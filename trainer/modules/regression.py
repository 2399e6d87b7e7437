"""Supervised training of a denoiser with one loss and one optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from models.denoiser import Denoiser
from trainer.losses import SMAPE
from trainer.modules.evaluation import Batch, Evaluated
from trainer.schedules import OneCycle


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
        optimizer: Callable[[Iterable], Optimizer] = torch.optim.Adam,
        lr_scheduler: Callable[[Optimizer], LRScheduler] | None = None,
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

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Return the optimiser, with its schedule if there is one."""
        optimizer = self.make_optimizer(self.net.parameters())
        if self.make_lr_scheduler is None:
            return optimizer
        schedule = self.make_lr_scheduler(optimizer)
        if isinstance(schedule, OneCycle):
            schedule.span(int(self.trainer.estimated_stepping_batches))
        interval = getattr(schedule, "interval", "epoch")
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": interval}}
