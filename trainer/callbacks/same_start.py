"""Refuses a training whose ranks would go on from different steps."""

from __future__ import annotations

from typing import Any

import torch.distributed as dist
from lightning.pytorch import Callback, LightningModule, Trainer


class SameStart(Callback):
    """Compares the step that each rank begins from; set where there are several ranks.

    A node that does not see the run of a restarted training would begin it anew beside ranks that go on, with
    fresh optimizer states and other samples, and nothing else would tell.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Compare.

        Raises:
            ValueError: Some ranks begin from other steps; on all ranks.
        """
        steps: list[Any] = [None] * trainer.world_size
        dist.all_gather_object(steps, trainer.global_step)
        if len(set(steps)) > 1:
            groups = [
                f"{_ranks([rank for rank, other in enumerate(steps) if other == step])} at step {step}"
                for step in sorted(set(steps))
            ]
            raise ValueError(
                f"ranks begin from different checkpoints: {', '.join(groups)}; nodes have to share the "
                "folder of the runs, and have the same command line or a PENUMBRA_TRAINING that names the "
                "training"
            )


def _ranks(ranks: list[int]) -> str:
    shown = ", ".join(map(str, ranks[:4])) + (" …" if len(ranks) > 4 else "")
    return f"rank {shown}" if len(ranks) == 1 else f"ranks {shown}"
