from __future__ import annotations

import re
import time
from types import SimpleNamespace

import pytest

from trainer.callbacks.progress import TrainingProgress


def test_throughput_of_shards_at_a_url_is_told_and_logged_beside_patches():
    progress = TrainingProgress()
    loader = SimpleNamespace(remote=True, read_bytes=0, downloaded_bytes=0, waited_s=0.0)
    trainer = SimpleNamespace(train_dataloader=loader, world_size=2, callback_metrics={})
    progress._mark = progress._mark._replace(time=time.monotonic() - 2)
    loader.read_bytes, loader.downloaded_bytes, progress._patches = 40_000_000, 10_000_000, 8
    progress._measure(trainer)
    found = progress._throughput()
    assert found["throughput/read_mb_per_s"] == pytest.approx(40, rel=0.2)
    assert found["throughput/downloaded_mb_per_s"] == pytest.approx(10, rel=0.2)
    assert any(
        re.fullmatch(r"shards [\d.]+ MB/s, [\d.]+ MB/s downloaded", n) for n in progress._numbers(trainer)
    )
    loader.remote = False
    local = TrainingProgress()
    local._measure(trainer)
    assert local._throughput().keys() == {"throughput/patches_per_s", "throughput/waiting"}
