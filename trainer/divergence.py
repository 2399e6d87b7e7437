"""Stops a training that diverges, with the batch saved and the reason said."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer

from trainer.tracking import MLflowTracking

REMEDY = "Try gradient clipping (--trainer.gradient_clip_val 1) or a smaller learning rate."
"""What to do, for a training module that has no `remedy` of its own."""


def diverged(module: LightningModule, batch: Mapping[str, Any], reason: str) -> ValueError:
    """Save a batch beside the run and return the error to raise.

    Args:
        module: The training module; its attribute `remedy`, where it has one, ends the message.
        batch: The batch of the step that must not be taken.
        reason: What went wrong: `the loss became nan at step 12`.
    """
    trainer = module.trainer
    path, bad = save_batch(trainer, batch)
    cause = f"not finite in the batch: {', '.join(bad)}" if bad else "the batch itself is finite"
    return ValueError(f"{reason}; {cause}. The batch is in {path}. {getattr(module, 'remedy', REMEDY)}")


def save_batch(trainer: Trainer, batch: Mapping[str, Any]) -> tuple[Path, list[str]]:
    """Write a batch into the run's folder; returns the file and the names of what is not finite in it."""
    folder = trainer.logger.folder if isinstance(trainer.logger, MLflowTracking) else Path()
    path = folder / f"nonfinite-step{trainer.global_step + 1}-rank{trainer.global_rank}.pt"
    tensors = {k: v for k, v in batch.items() if isinstance(v, torch.Tensor)}
    torch.save({**batch, **{k: v.cpu() for k, v in tensors.items()}}, path)
    return path, [k for k, v in tensors.items() if not bool(torch.isfinite(v).all())]
