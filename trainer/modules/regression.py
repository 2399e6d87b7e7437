"""Supervised training of a denoiser with one loss and one optimiser."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim import Optimizer

from models.denoiser import Denoiser
from trainer.losses import SMAPE
from trainer.modules.evaluation import Batch, Evaluated
from trainer.modules.updates import check_number
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
        clip_norm: Gradients are scaled down to this norm, before `clip_value`; the trainer's
            `gradient_clip_val` does one of both.
        clip_value: Every number of a gradient is clipped to +- this.
        pairs: Compare what the method's paper compares (`Denoiser.training_pairs`) instead.
    """

    def __init__(
        self,
        net: Denoiser,
        loss: nn.Module | None = None,
        optimizer: MakeOptimizer = torch.optim.Adam,
        lr_scheduler: MakeSchedule | None = None,
        clip_norm: float | None = None,
        clip_value: float | None = None,
        pairs: bool = False,
    ) -> None:
        super().__init__(net)
        self.keep_arguments()
        check_number("clip_norm", clip_norm)
        check_number("clip_value", clip_value)
        self.clip_norm, self.clip_value, self.pairs = clip_norm, clip_value, pairs
        self.loss = loss if loss is not None else SMAPE()
        self.make_optimizer = optimizer
        self.make_lr_scheduler = lr_scheduler

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch."""
        loss = self._compared(batch) if self.pairs else self.loss(*self.exposed(batch))
        self.log("train/loss_step", loss)
        self.count_loss(loss)
        return loss

    def validation_loss(self, batch: Batch, output: Tensor, target: Tensor) -> Tensor:
        """Return the loss of exposed output and reference, or of what the method's paper compares."""
        loss: Tensor = self._compared(batch) if self.pairs else self.loss(output, target)
        return loss

    def _compared(self, batch: Batch) -> Tensor:
        pairs = self.net.training_pairs(batch).values()
        return torch.stack([self.loss(pair.output, pair.target) for pair in pairs]).sum()

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip norm and values, each where it is asked for; or as the trainer says.

        Raises:
            ValueError: Both say it.
        """
        own = self.clip_norm is not None or self.clip_value is not None
        if own and gradient_clip_val:
            raise ValueError(
                "gradients are clipped twice: use --trainer.gradient_clip_val null, or none of "
                "--model.clip_norm and --model.clip_value"
            )
        if self.clip_norm is not None:
            clip_grad_norm_(self.net.parameters(), self.clip_norm)
        if self.clip_value is not None:
            clip_grad_value_(self.net.parameters(), self.clip_value)
        if not own:
            self.clip_gradients(optimizer, gradient_clip_val, gradient_clip_algorithm)

    def configure_optimizers(self) -> dict[str, Any]:  # type: ignore[override]
        """Return the optimiser, with its schedule if there is one."""
        optimizer = self.make_optimizer(self.net.parameters())
        steps = self.trainer.estimated_stepping_batches
        return scheduled(optimizer, self.make_lr_scheduler, steps, "Regression")
