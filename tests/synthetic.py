"""A tiny data module with exact buffers and known noise, for tests of the training side."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset


def patch(seed: int, size: int = 32) -> dict[str, Any]:
    """Return one patch: a tilted plane with a step in albedo, lit by a gradient, with exponential noise."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    albedo = torch.where(x > torch.rand((), generator=generator), 0.8, 0.3).expand(3, -1, -1)
    light = (0.2 + y).expand(3, -1, -1)
    noise = torch.empty(size, size).exponential_(generator=generator)
    normal = torch.nn.functional.normalize(torch.stack([x - 0.5, y - 0.5, torch.ones_like(x)]), dim=0)
    irradiance = light * noise
    return {
        "irradiance": irradiance, "albedo": albedo, "normal": normal, "depth": (1 + x)[None],
        "color": irradiance * albedo, "reference": light * albedo, "exposure": torch.tensor(1.0),
        "depth_range": torch.tensor([1.0, 2.0]), "scene": "plane" if seed % 2 else "step", "frame": seed,
    }  # fmt: skip


class Patches(Dataset[dict[str, Any]]):
    def __init__(self, count: int, first: int) -> None:
        self.count, self.first = count, first

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        return patch(self.first + index)


class Synthetic(LightningDataModule):
    """Sixteen training and four evaluation patches."""

    manifest_hash = "synthetic"

    def __init__(
        self,
        batch_size: int = 4,
        count: int = 16,
        buffers: tuple[str, ...] | None = None,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        self.batch_size = batch_size
        self.count = count

    def scenes(self, split: str) -> tuple[str, ...]:
        return ("plane", "step")

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        return DataLoader(Patches(self.count, 100), self.batch_size)

    def val_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        return DataLoader(Patches(4, 0), self.batch_size)

    def test_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        return DataLoader(Patches(4, 50), 1)
