"""Stops training at the first loss that is not a number, with the batch that caused it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.tracking import MLflowTracking


class FiniteGuard(Callback):
    """Raise when the loss of a step is NaN or infinite; save the batch beside the run."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Learn the run's folder while all ranks still work together."""
        if stage == "fit" and isinstance(trainer.logger, MLflowTracking):
            trainer.logger.share_folder(trainer.strategy.broadcast)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Check the loss of the step.

        Raises:
            ValueError: Names the step, the file that holds the batch and buffers that are not finite.
        """
        loss = outputs["loss"] if isinstance(outputs, dict) else outputs
        if loss is None or bool(torch.isfinite(loss).all()):
            return
        folder = trainer.logger.folder if isinstance(trainer.logger, MLflowTracking) else Path()
        path = folder / f"nonfinite-step{trainer.global_step}-rank{trainer.global_rank}.pt"
        tensors = {k: v for k, v in batch.items() if isinstance(v, torch.Tensor)}
        torch.save({**batch, **{k: v.cpu() for k, v in tensors.items()}}, path)
        bad = [k for k, v in tensors.items() if not bool(torch.isfinite(v).all())]
        cause = f"not finite in the batch: {', '.join(bad)}" if bad else "the batch itself is finite"
        raise ValueError(
            f"the loss became {float(loss)} at step {trainer.global_step}; {cause}. The batch is in {path}. "
            "Try gradient clipping (--trainer.gradient_clip_val 1) or a smaller learning rate."
        )
