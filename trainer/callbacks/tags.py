"""Tags of a run, such as that of the run that it belongs to."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.tracking import MLflowTracking


class RunTags(Callback):
    """Tags the run in MLflow when its training begins.

    Args:
        tags: Name → text. `mlflow.parentRunId` puts the run below another one.
    """

    def __init__(self, tags: dict[str, str]) -> None:
        self.tags = dict(tags)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the tags."""
        if trainer.is_global_zero and isinstance(trainer.logger, MLflowTracking):
            trainer.logger.set_tags(self.tags)
