"""Two ranks read shards under Lightning: `python -m tests.data.ddp_reading SHARDS OUTPUT [FRAMES]`.

Each rank writes what it saw to OUTPUT/<rank>.json. With FRAMES the shards hold clips, and whole scenes are
tested.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer

from data.module import Shards


class Seen(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.keys: dict[str, list[list[str]]] = {"train": [], "validation": [], "test": []}

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> torch.Tensor:
        self.keys["train"].append(batch["key"])
        return self.weight * 0

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self.keys["validation"].append(batch["key"])

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self.keys["test"].append(batch["key"])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), 0.1)


def main(shards: str, output: str, frames: str = "1") -> None:
    warnings.simplefilter("ignore")
    clips: dict[str, Any] = {"frames": int(frames), "whole_scenes": int(frames) > 1}
    net, data = Seen(), Shards(shards, batch_size=2, buffers=("depth",), **clips)
    trainer = Trainer(
        accelerator="cpu",
        devices=2,
        strategy="ddp",
        max_epochs=2,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        default_root_dir=output,
    )
    trainer.fit(net, datamodule=data)
    trainer.test(net, datamodule=data, verbose=False)
    (Path(output) / f"{trainer.global_rank}.json").write_text(json.dumps(net.keys))


if __name__ == "__main__":
    main(*sys.argv[1:])
