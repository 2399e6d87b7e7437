"""Figure 3: the loader against a memory map of the same bytes.

    python -m tests.benchmarks.loader

Both deliver the buffers that WSKP trains on (irradiance, albedo, normal and reference stored in half
precision, depth in float32, 128x128 pixels) as float32 batches of 8, in the same shuffled order, through one
DataLoader worker, from files in the page cache. The plain ways map two files, (N, 12, H, W) float16 and (N,
1, H, W) float32, and do nothing else. One converts each sample with torch and lets torch's default collation
stack them into shared memory; the other converts sample by sample into a float32 batch that is sent at once.
The target counts against the faster of the two. The loader also finds samples by the index, flips and rotates
them, and hands over exposure, depth range, scene, frame and key; on the first pass of a worker it verifies
checksums, which is reported apart.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from data.module import Shards
from data.shards.index import Index
from data.shards.plan import training_epoch
from data.shards.write import ShardWriter
from tests.benchmarks.timing import row

SAMPLES, SHARDS, SIZE, BATCH, REPEATS = 384, 8, 128, 8, 7
HALF = ("irradiance", "albedo", "normal", "reference")
INPUTS = ("irradiance", "albedo", "normal", "depth")


class Plain(Dataset[dict[str, Tensor]]):
    """Samples of two memory maps, as float32."""

    def __init__(self, folder: Path) -> None:
        self.half = np.memmap(folder / "half", np.float16, "r+", shape=(SAMPLES, 12, SIZE, SIZE))
        self.depth = np.memmap(folder / "depth", np.float32, "r+", shape=(SAMPLES, 1, SIZE, SIZE))

    def __len__(self) -> int:
        return SAMPLES

    def __getitem__(self, number: int) -> dict[str, Tensor]:
        half = torch.from_numpy(self.half[number]).float()
        sample = {name: half[3 * i : 3 * i + 3] for i, name in enumerate(HALF)}
        return {**sample, "depth": torch.from_numpy(self.depth[number])}


class PlainBatches(Dataset[dict[str, Tensor]]):
    """Batches of two memory maps, each sample converted into its place."""

    def __init__(self, folder: Path) -> None:
        self.samples = Plain(folder)

    def __len__(self) -> int:
        return SAMPLES

    def __getitem__(self, numbers: list[int]) -> dict[str, Tensor]:
        half = torch.empty(len(numbers), 12, SIZE, SIZE)
        depth = torch.empty(len(numbers), 1, SIZE, SIZE)
        for place, number in enumerate(numbers):
            half[place].copy_(torch.from_numpy(self.samples.half[number]))
            depth[place].copy_(torch.from_numpy(self.samples.depth[number]))
        return {**{name: half[:, 3 * i : 3 * i + 3] for i, name in enumerate(HALF)}, "depth": depth}


def write(folder: Path) -> Index:
    """Write random samples as shards and as plain arrays."""
    half = np.memmap(folder / "half", np.float16, "w+", shape=(SAMPLES, 12, SIZE, SIZE))
    depth = np.memmap(folder / "depth", np.float32, "w+", shape=(SAMPLES, 1, SIZE, SIZE))
    generator = np.random.default_rng(1)
    root = folder / "shards"
    root.mkdir()
    records = []
    for shard in range(SHARDS):
        with ShardWriter(root / f"train-{shard:05d}.tar", "train", "noise") as writer:
            for number in range(shard * SAMPLES // SHARDS, (shard + 1) * SAMPLES // SHARDS):
                half[number] = generator.random((12, SIZE, SIZE), np.float32)
                depth[number] = generator.random((1, SIZE, SIZE), np.float32)
                writer.add(meta(number), buffers(half[number], depth[number]))
            records.append(writer.finish())
    index = Index(root, "noise", {}, {}, tuple(records))
    index.write()
    return index


def meta(number: int) -> dict[str, Any]:
    """Return the description of a sample."""
    return {
        "scene": "noise", "frame": number, "x": 0, "y": 0, "width": SIZE, "height": SIZE,
        "exposure": 1.0, "depth_range": [0.0, 1.0], "accumulated": True,
    }  # fmt: skip


def buffers(half: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    """Return the buffers of a sample, float32 (H, W, C)."""
    images = {name: half[3 * i : 3 * i + 3] for i, name in enumerate(HALF)} | {"depth": depth}
    return {name: image.transpose(1, 2, 0).astype(np.float32) for name, image in images.items()}


def rate(loader: Iterable[Any]) -> float:
    """Return samples per second of one pass, from the first batch on, when the worker is running."""
    batches = iter(loader)
    next(batches)
    start = time.perf_counter()
    count = sum(len(batch["reference"]) for batch in batches)
    return count / (time.perf_counter() - start)


def run() -> list[dict[str, Any]]:
    """Measure both in turn and return the medians."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        index = write(folder)
        module = Shards(str(index.root), batch_size=BATCH, workers=1, buffers=INPUTS)
        ours = module.train_dataloader()
        order = training_epoch(ours.batches.reader.shard_sizes, 1, 0, 0, 1, BATCH).tolist()
        options: dict[str, Any] = {"num_workers": 1, "persistent_workers": True}
        loaders: dict[str, Iterable[Any]] = {
            "samples": DataLoader(Plain(folder), batch_sampler=order, **options),
            "batches": DataLoader(PlainBatches(folder), batch_size=None, sampler=order, **options),
            "ours": ours,
        }
        first = {name: rate(loader) for name, loader in loaders.items()}  # ours verifies checksums
        rates: dict[str, list[float]] = {name: [] for name in loaders}
        for _ in range(REPEATS):
            for name, loader in loaders.items():
                rates[name].append(rate(loader))
        module.teardown("fit")
    median = {name: statistics.median(values) for name, values in rates.items()}
    best = max("samples", "batches", key=median.__getitem__)
    ratio = statistics.median(o / p for o, p in zip(rates["ours"], rates[best], strict=True))
    return [
        row("loader / memory map, one worker, batches of 8", ratio, "x", ">= 0.8", ratio >= 0.8),
        row("loader", median["ours"], "samples/s"),
        row("loader, first pass (checksums)", first["ours"], "samples/s"),
        row("memory map, samples and default collation", median["samples"], "samples/s"),
        row("memory map, converted into the batch", median["batches"], "samples/s"),
    ]


if __name__ == "__main__":
    for figure in run():
        print(figure)
