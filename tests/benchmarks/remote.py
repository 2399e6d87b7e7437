"""Shards on a loopback S3 server: bandwidth of reading them, and what training waits for them.

    python -m tests.benchmarks.remote

An S3 server (SeaweedFS) is started on this machine, and shards with the buffers of WSKP are sent to it. One
loader with one worker reads them from the disk, from S3 with an empty cache, and again in the second epoch;
and with a cache of 30% of the set, where most samples are read by themselves over the network. Then WSKP
trains on them, with an empty cache and in the second epoch. Server, worker and training share the cores of
this machine, so on a machine with few of them the network costs what a remote server would not; rates are of
the bytes of samples as they are stored.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from data import remote
from data.module import Shards
from data.shards.index import Index
from tests.benchmarks.loader import BATCH, INPUTS, write
from tests.benchmarks.timing import Row, print_table, row
from tests.data.remote_servers import S3Server

URL = "s3://bench/shards"
STEPS = 10
"""Of WSKP, per epoch."""


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables for a while."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def pass_rate(loader: Any, batches: Iterable[Any]) -> tuple[float, float]:
    """Return MB/s of samples and of downloads over one pass."""
    start, read, downloaded = time.perf_counter(), loader.read_bytes, loader.downloaded_bytes
    for _ in batches:
        pass
    seconds = (time.perf_counter() - start) * 1e6
    return (loader.read_bytes - read) / seconds, (loader.downloaded_bytes - downloaded) / seconds


def bandwidth(index: Index, cache: Path) -> list[Row]:
    """Read all training samples from the disk and from S3."""
    size = sum(shard.bytes for shard in index.shards)
    rows, rates = [], {}
    for name, root, gigabytes in (
        ("disk", str(index.root), 50.0),
        ("S3", URL, 50.0),
        ("S3, cache of 30%", URL, 0.3 * size / 1e9),
    ):
        with environment({"PENUMBRA_CACHE": str(cache / name.replace(" ", "-"))}):
            data = Shards(root, BATCH, workers=1, buffers=INPUTS, cache_gb=gigabytes)
            loader = data.train_dataloader()
            for epoch in range(3):
                loader.set_epoch(epoch)
                rates[name, epoch] = pass_rate(loader, loader)
            data.teardown("fit")
    for name, epoch in (("disk", 0), ("disk", 2), ("S3", 0), ("S3", 2), ("S3, cache of 30%", 2)):
        read, downloaded = rates[name, epoch]
        which = "first epoch, worker's start included" if epoch == 0 else "third epoch"
        rows.append(row(f"{name}, {which}: samples", read, "MB/s"))
        if downloaded:
            rows.append(row(f"{name}, {which}: downloaded", downloaded, "MB/s"))
    ratio = rates["S3", 2][0] / rates["disk", 2][0]
    rows.append(row("S3 / disk, third epoch", ratio, "x", ">= 0.9", ratio >= 0.9))
    return rows


def whole_shards(index: Index, folder: Path) -> list[Row]:
    """Download every shard, verified, one after another."""
    start = time.perf_counter()
    for shard in index.shards:
        remote.fetch(remote.join(URL, shard.file), folder / "shard", size=shard.bytes, sha256=shard.sha256)
    size = sum(shard.bytes for shard in index.shards)
    return [row("whole shards, one at a time, verified", size / (time.perf_counter() - start) / 1e6, "MB/s")]


def training(root: str, cache: Path) -> list[float]:
    """Return the share of the time that WSKP waits for data in the first and in the second epoch."""
    from models import WSKP
    from trainer.losses import SMAPE

    net, loss = WSKP(), SMAPE()
    optimizer = torch.optim.Adam(net.parameters())
    with environment({"PENUMBRA_CACHE": str(cache)}):
        data = Shards(root, BATCH, workers=1, buffers=net.inputs)
        loader = data.train_dataloader()
        shares = []
        for epoch in range(2):
            loader.set_epoch(epoch)
            began, waited = time.perf_counter(), loader.waited_s
            for number, batch in enumerate(loader):
                optimizer.zero_grad()
                loss(net(batch).color, batch["reference"]).backward()
                optimizer.step()
                if number + 1 == STEPS:
                    break
            shares.append((loader.waited_s - waited) / (time.perf_counter() - began))
        data.teardown("fit")
    return shares


def run() -> list[Row]:
    """Measure, with a server that is started and stopped here."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        index = write(folder)
        server = S3Server(folder / "server")
        server.start()
        try:
            with environment(server.environment):
                server.make_bucket("bench")
                for path in sorted(index.root.iterdir()):
                    remote.send(path, remote.join(URL, path.name))
                rows = whole_shards(index, folder) + bandwidth(index, folder / "cache")
                local = training(str(index.root), folder / "unused")
                remote_shares = training(URL, folder / "training")
        finally:
            server.stop()
    for epoch, name in enumerate(("first epoch, worker's start included", "second epoch")):
        rows.append(row(f"WSKP waits, disk, {name}", 100 * local[epoch], "%"))
        rows.append(row(f"WSKP waits, S3, {name}", 100 * remote_shares[epoch], "%"))
    return rows


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))  # so that the server is stopped
    print_table(run())
