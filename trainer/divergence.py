"""Stops a training that diverges, with the batch saved and the reason said."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule

from trainer.tracking import MLflowTracking

REMEDY = "Try gradient clipping (--trainer.gradient_clip_val 1) or a smaller learning rate."
"""What to do, for a training module that has no `remedy` of its own."""


def diverged(module: LightningModule, batch: Mapping[str, Any], reason: str, taken: int = 0) -> ValueError:
    """Save a batch beside the run and return the error to raise.

    Args:
        module: The training module; its attribute `remedy`, where it has one, ends the message.
        batch: The batch that was to be learned from.
        reason: What went wrong: `the loss became nan`.
        taken: 1 where the step was taken already, otherwise it is the next one.
    """
    trainer = module.trainer
    step = trainer.global_step + 1 - taken
    folder = trainer.logger.folder if isinstance(trainer.logger, MLflowTracking) else Path()
    path = folder / f"diverged-step{step}-rank{trainer.global_rank}.pt"
    tensors = {k: v for k, v in batch.items() if isinstance(v, torch.Tensor)}
    torch.save({**batch, **{k: v.cpu() for k, v in tensors.items()}}, path)
    bad = [k for k, v in tensors.items() if not bool(torch.isfinite(v).all())]
    cause = f"not finite in the batch: {', '.join(bad)}" if bad else "the batch itself is finite"
    remedy = getattr(module, "remedy", REMEDY)
    return ValueError(f"{reason} at step {step}; {cause}. The batch is in {path}. {remedy}")
