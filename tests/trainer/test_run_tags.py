"""Tags that a configuration gives a run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from lightning.pytorch import LightningModule

from trainer.callbacks import RunTags
from trainer.spool.store import local_store, open_client
from trainer.tracking import MLflowTracking


def test_the_first_rank_tags_the_run_when_training_begins(workplace: Path) -> None:
    logger = MLflowTracking("tags", system_metrics=False)
    callback = RunTags({"mlflow.parentRunId": "abc", "purpose": "test"})
    for first in (True, False):
        trainer = cast(Any, SimpleNamespace(is_global_zero=first, logger=logger))
        callback.on_fit_start(trainer, LightningModule())
        callback.tags["purpose"] = "of another rank"
    logger.finalize("success")
    run = open_client(local_store(workplace / "runs")).get_run(logger.run_id)
    assert run.data.tags["mlflow.parentRunId"] == "abc"
    assert run.data.tags["purpose"] == "test"


def test_a_training_without_mlflow_is_left_alone() -> None:
    trainer = cast(Any, SimpleNamespace(is_global_zero=True, logger=None))
    RunTags({"a": "b"}).on_fit_start(trainer, LightningModule())
