"""Shards at a URL give the batches that they give on this machine, from any server and with any cache."""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from data import remote_patience
from data.module import Shards
from data.root import resolve_root
from data.shards import cache as shard_cache
from data.shards.cache import ShardCache
from data.shards.index import INDEX, Index
from data.shards.plan import shards_ahead
from data.shards.read import CorruptSampleError, ShardReader
from tests.data.remote_servers import Handler, WebServer
from tests.data.small_sets import write_shards
from tests.data.test_shards_read import flip_byte

NAMES = ("color", "depth")


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Index:
    return write_shards(tmp_path_factory.mktemp("shards"))


@pytest.fixture(scope="module")
def expected(index: Index) -> list[Any]:
    return batches(Shards(str(index.root), 4, 0, buffers=NAMES))


@pytest.fixture
def web(index: Index) -> Iterator[WebServer]:
    with WebServer(index.root.parent) as server:
        yield server


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(remote_patience, "FIRST_PAUSE_S", 0.01)
    return tmp_path / "cache" / "remote"


def batches(data: Shards, epochs: int = 2) -> list[Any]:
    """Return training batches of some epochs, and those of validation and test."""
    loader = data.train_dataloader()
    found: list[Any] = []
    for epoch in range(epochs):
        loader.set_epoch(epoch)
        found += list(loader)
    found += [*data.val_dataloader(), *data.test_dataloader()]
    data.teardown("fit")
    return found


def assert_same(found: list[Any], wanted: list[Any]) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            equal = (
                torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
            )
            assert equal, name


def size(cache: Path) -> int:
    """Return the bytes of the cache, downloads that go on included."""
    total = 0
    for path in [*cache.glob("*.tar"), *cache.glob(".*.partial")]:
        try:
            total += path.stat().st_size
        except FileNotFoundError:  # renamed meanwhile
            continue
    return total


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("workers", [0, 2])
def test_batches_are_those_of_the_same_shards_on_this_machine(index, expected, web, workers, ranges):
    web.ranges = ranges
    data = Shards(f"{web.url}/shards", 4, workers, buffers=NAMES)
    assert data.manifest_hash == index.manifest_hash
    assert_same(batches(data), expected)


def test_the_second_epoch_is_read_from_the_copies(index, web, cache):
    web.ranges = False
    data = Shards(f"{web.url}/shards", 4, 0, buffers=NAMES)
    loader = data.train_dataloader()
    list(loader)
    first = loader.downloaded_bytes
    assert first == sum(shard.bytes for shard in index.of("train"))
    loader.set_epoch(1)
    list(loader)
    assert loader.downloaded_bytes == first
    assert loader.read_bytes == 2 * len(loader) * 4 * index.of("train")[0].samples[0].size
    assert all(web.asked[f"GET /shards/{shard.file}"] <= 2 for shard in index.of("train"))


@pytest.mark.parametrize("ranges", [True, False])
def test_a_set_that_is_larger_than_the_cache_is_read_completely_within_the_bound(
    index, expected, web, cache, ranges, capfd
):
    web.ranges = ranges
    largest = max(shard.bytes for shard in index.of("train"))
    limit = 3 * largest
    assert limit < sum(shard.bytes for shard in index.of("train")) / 2
    data = Shards(f"{web.url}/shards", 4, 0, buffers=NAMES, cache_gb=limit / 1e9)
    loader = data.train_dataloader()
    found = []
    for epoch in range(2):
        loader.set_epoch(epoch)
        for batch in loader:
            found.append(batch)
            assert size(cache) <= limit + (0 if ranges else largest)  # the shard in use
    assert_same(found, expected[: len(found)])
    assert ("they are downloaded over and over; raise --data.cache_gb" in capfd.readouterr().err) != ranges


def test_a_shard_in_use_stays_and_others_leave_longest_unused_first(index, web, cache):
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    shards = at_url.of("train")[:5]
    limit = sum(shard.bytes for shard in shards[:3])
    copies = ShardCache(at_url, limit)
    for number, shard in enumerate(shards[:3]):
        assert copies.add(shard)
        os.utime(cache / f"{shard.sha256}.tar", (1000 + number, 1000 + number))
    assert not copies.add(shards[3]), "shards of the same set make no room for each other unasked"
    file = copies.open(shards[0])
    assert file is not None
    os.utime(cache / f"{shards[0].sha256}.tar", (1, 1))
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        file.close()  # the map holds the lock
        assert copies.add(shards[3], wanted_now=True)
        assert [copies.has(shard) for shard in shards] == [True, False, True, True, False]
        (cache / f"{shards[0].sha256}.tar").unlink()
        assert mapped[:] == (index.root / shards[0].file).read_bytes(), "readable though removed by hand"


def test_a_cache_without_room_is_not_looked_at_again_for_a_while(index, web, cache, monkeypatch):
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    small, *others = sorted(at_url.of("train"), key=lambda shard: shard.bytes)
    copies, looks = ShardCache(at_url, small.bytes), []
    look = copies._make_room
    monkeypatch.setattr(copies, "_make_room", lambda *args: looks.append(args) or look(*args))
    assert copies.add(small)
    for _ in range(3):
        assert not any(copies.add(shard) for shard in others)
    assert len(looks) == 2
    assert copies.add(others[0], wanted_now=True), "who needs it now gets it"
    assert not copies.add(others[1])
    assert len(looks) == 3
    later = time.monotonic() + 1.1
    monkeypatch.setattr(shard_cache, "time", SimpleNamespace(monotonic=lambda: later))
    assert not copies.add(others[1])
    assert len(looks) == 4


def test_threads_that_download_ahead_end_with_their_loader(index, web, cache):
    others = set(threading.enumerate())
    data = Shards(f"{web.url}/shards", 4, 0, buffers=NAMES)
    next(iter(data.train_dataloader()))
    begun = {thread for thread in threading.enumerate() if thread.name.startswith("prefetch-")} - others
    assert len(begun) == 2
    data.teardown("fit")
    for thread in begun:
        thread.join(30)
    assert not any(thread.is_alive() for thread in begun)


def test_shards_of_another_set_make_room(index, web, cache, tmp_path, monkeypatch):
    monkeypatch.setattr(shard_cache, "LOOK_AGAIN_S", 0.0)
    cache.mkdir(parents=True)
    other = cache / f"{'0' * 64}.tar"
    other.write_bytes(bytes(index.of("train")[0].bytes))
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    copies = ShardCache(at_url, at_url.of("train")[0].bytes + 100)
    with other.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        assert not copies.add(at_url.of("train")[0])
    assert copies.add(at_url.of("train")[0])
    assert not other.exists()


def test_what_a_killed_download_left_is_removed_and_one_that_goes_on_is_counted(
    index, web, cache, monkeypatch
):
    monkeypatch.setattr(shard_cache, "LOOK_AGAIN_S", 0.0)
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    one, two = at_url.of("train")[:2]
    copies = ShardCache(at_url, one.bytes + two.bytes)
    cache.mkdir(parents=True)
    left = cache / f".{two.sha256}.{two.bytes}.partial"
    left.write_bytes(b"cut")
    with left.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert not copies.add(two), "somebody else is at it"
        assert copies.add(one)
        assert not copies.add(at_url.of("train")[2]), "the room is taken"
    assert copies.add(two)
    assert not list(cache.glob(".*.partial"))
    assert (cache / f"{two.sha256}.tar").read_bytes() == (index.root / two.file).read_bytes()


def test_who_waits_for_a_shard_is_not_held_up_by_who_reads_it(index, web, cache):
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    copies, shard = ShardCache(at_url, 1 << 30), at_url.of("train")[0]
    web.fault = lambda handler, data: bool(time.sleep(0.2))
    held = []

    def read() -> None:
        assert copies.add(shard, wanted_now=True)
        held.append(copies.open(shard))

    readers = [threading.Thread(target=read, daemon=True) for _ in range(6)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join(30)
    assert len(held) == len(readers), "some wait for ever"
    assert web.asked[f"GET /shards/{shard.file}"] == 1
    for file in held:
        file.close()


def _swap(handler: Handler, data: bytes) -> bool:
    """Answer with a changed byte."""
    wrong = bytearray(data)
    wrong[700] ^= 1
    handler.answer(200, bytes(wrong))
    return True


def test_a_download_with_another_checksum_is_fetched_again(index, web, cache):
    web.ranges = False
    faults = iter([_swap, _swap])
    web.fault = lambda handler, data: (
        next(faults, lambda h, d: False)(handler, data) if handler.path.endswith("train-00000.tar") else False
    )
    at_url = Index.read_remote(f"{web.url}/shards", cache)
    assert ShardCache(at_url, 1 << 30).add(at_url.of("train")[0])
    assert web.asked["GET /shards/train-00000.tar"] == 3


@pytest.mark.parametrize("ranges", [True, False])
def test_a_shard_that_stays_wrong_is_a_corrupt_sample_that_can_be_skipped(index, tmp_path, capfd, ranges):
    root = tmp_path / "shards"
    root.mkdir()
    for path in index.root.iterdir():
        (root / path.name).write_bytes(path.read_bytes())
    flip_byte(root / "train-00000.tar", index.of("train")[0].samples[1].offset + 700)
    with WebServer(tmp_path) as web:
        web.ranges = ranges
        at_url = Index.read_remote(f"{web.url}/shards", tmp_path / "copies")
        reader = ShardReader(at_url, "train", cache=ShardCache(at_url, 1 << 30))
        with pytest.raises(CorruptSampleError, match=r"http://.*train-00000.tar, sample .*checksum"):
            reader.sample(1)
        if ranges:
            reader.sample(0)
        data = Shards(f"{web.url}/shards", 4, 0, buffers=NAMES, on_corrupt="skip")
        loader = data.train_dataloader()
        with pytest.warns(UserWarning, match=r"left out \(\d+ so far\): http"):
            list(loader)
        assert all("train-00000" in name for name in data.corrupt)
        (root / "train-00001.tar").unlink()
        with pytest.raises(CorruptSampleError, match=r"train-00001.tar, sample .*: the file is missing"):
            reader.sample(reader.shard_sizes[0])


def test_a_run_resumes_in_the_middle_of_an_epoch(index, expected, web):
    data = Shards(f"{web.url}/shards", 4, 2, buffers=NAMES)
    loader = data.train_dataloader()
    loader.load_state_dict({**loader.state_dict(), "epoch": 1, "batch": 3})
    length = len(loader)
    assert_same(list(loader), expected[length + 3 : 2 * length])
    data.teardown("fit")


@pytest.mark.slow
def test_two_ranks_read_what_they_read_on_this_machine(index, web, tmp_path):
    seen = []
    for name, root in (("local", str(index.root)), ("remote", f"{web.url}/shards")):
        (tmp_path / name).mkdir()
        command = [sys.executable, "-m", "tests.data.ddp_reading", root, str(tmp_path / name)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run(command, check=True, timeout=280, env=environment, capture_output=True)
        seen.append([json.loads((tmp_path / name / f"{rank}.json").read_text()) for rank in (0, 1)])
    assert seen[0] == seen[1]


def test_what_a_url_holds_is_told_apart(index, tmp_path):
    for name, file in (("frames", "manifest.json"), ("begun", "upload.json"), ("none", "x")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text("{}")
    with WebServer(tmp_path) as web:
        with pytest.raises(ValueError, match=r"/frames holds frames; .*trainer prepare FRAMES --output"):
            resolve_root(f"{web.url}/frames")
        with pytest.raises(ValueError, match=r"/begun is not finished.*continue it with: trainer prepare"):
            resolve_root(f"{web.url}/begun")
        with pytest.raises(FileNotFoundError, match=r"/none holds no shards \(there is no index.json\)"):
            Shards(f"{web.url}/none").prepare_data()
        (tmp_path / "none" / INDEX).write_text("[" * 100_000)
        with pytest.raises(ValueError, match="is not an index of shards that this version reads"):
            Shards(f"{web.url}/none").setup("fit")


def test_a_cache_without_size_is_refused():
    with pytest.raises(ValueError, match="cache_gb is 0; expected gigabytes, more than 0"):
        Shards(cache_gb=0)


def test_shards_ahead_are_those_needed_next_each_once():
    ahead = shards_ahead([4, 4, 4], [[0, 9], [5, 1], [10, 11]])
    assert ahead == [(0, 2, 1), (1, 0, 2), (2,)]
