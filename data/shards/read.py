"""Reads shards through memory maps, straight to a sample by the index, with checksums."""

from __future__ import annotations

import json
import math
import mmap
import os
import tarfile
import warnings
import zlib
from bisect import bisect_right
from collections import OrderedDict
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from data.buffers import THIN_LENS
from data.shards.index import Index

DTYPES = {"<f2": torch.float16, "<f4": torch.float32}

OPEN_FILES = 256
"""Shards mapped at one time by one process; a limit of 1024 open files is common."""


class CorruptSampleError(ValueError):
    """A sample whose bytes are not those that were written.

    Attributes:
        sample: Shard and key, for counting.
    """

    def __init__(self, sample: str, message: str) -> None:
        super().__init__(message)
        self.sample = sample

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.sample, str(self))


Mapped = tuple[mmap.mmap, dict[torch.dtype, Tensor]]
"""A file in memory, and all of it as a tensor of each type."""


class Stored(NamedTuple):
    """Where an array of a sample lies in its shard: type, shape, (C, H, W) or (S, C, H, W), and first value
    counted in that type."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int


class Sample(NamedTuple):
    """What is known of a sample beside its pixels."""

    key: str
    scene: str
    frame: int
    exposure: float
    depth_range: tuple[float, float]
    accumulated: bool
    height: int
    width: int
    shard: int
    buffers: dict[str, Stored]
    sample_channels: tuple[str, ...] = ()
    thin_lens: tuple[float, float, float] = (0.0, 0.0, 0.0)


class ShardReader:
    """All samples of one split, numbered through its shards.

    Files are mapped on first use in each process, so a reader can be handed to worker processes.

    Args:
        index: Index of the folder.
        split: `train`, `validation` or `test`.
        verify: Compare each sample with its checksum when a process reads it for the first time.
    """

    def __init__(self, index: Index, split: str, verify: bool = True) -> None:
        self.index, self.split, self.verify = index, split, verify
        self.shards = index.of(split)
        sizes = [len(shard.samples) for shard in self.shards]
        self.shard_sizes = sizes
        self._first = [0, *accumulate(sizes)]
        self._forget()

    def __len__(self) -> int:
        return self._first[-1]

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in ("_maps", "_samples", "_pid"):
            del state[name]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    def _forget(self) -> None:
        self._pid = os.getpid()
        self._maps: OrderedDict[int, Mapped] = OrderedDict()
        self._samples: dict[int, Sample] = {}

    def locate(self, number: int) -> tuple[int, int]:
        """Return the shard of a sample and its place in it."""
        if not 0 <= number < len(self):
            raise IndexError(f"sample {number} of {len(self)} in split {self.split!r}")
        shard = bisect_right(self._first, number) - 1
        return shard, number - self._first[shard]

    def name(self, number: int) -> str:
        """Return shard and key of a sample, for messages."""
        shard, place = self.locate(number)
        record = self.shards[shard]
        return f"{self.index.root / record.file}, sample {record.samples[place].key}"

    def sample(self, number: int) -> Sample:
        """Return the description of a sample; verifies it when this process sees it for the first time.

        Raises:
            CorruptSampleError: The shard is missing or shorter than the index says, or the checksum differs.
        """
        if self._pid != os.getpid():
            self._forget()
        known = self._samples.get(number)
        if known is None:
            shard, place = self.locate(number)
            known = self._samples[number] = self._read(number, shard, place)
        return known

    def array(self, number: int, name: str) -> Tensor:
        """Return a stored array (C, H, W), `samples` (S, C, H, W), a read-only view of the mapped file.

        Raises:
            ValueError: The sample has no such buffer; the message lists what it has.
            CorruptSampleError: As `sample`.
        """
        sample = self.sample(number)
        stored = sample.buffers.get(name)
        if stored is None:
            raise ValueError(
                f"{self.name(number)} has no buffer {name!r}; it holds "
                f"{', '.join(sample.buffers)}. Prepare again from frames that have it: "
                f"trainer prepare FRAMES --output SHARDS --buffers {name},…"
            )
        _, views = self._map(number, sample.shard)
        strides = [math.prod(stored.shape[i + 1 :]) for i in range(len(stored.shape))]
        return views[stored.dtype].as_strided(stored.shape, strides, stored.start)

    def _read(self, number: int, shard: int, place: int) -> Sample:
        record = self.shards[shard].samples[place]
        mapped, _ = self._map(number, shard)
        if record.offset + record.size > len(mapped):
            raise self._corrupt(number, f"the file ends after {len(mapped)} bytes")
        raw = memoryview(mapped)[record.offset : record.offset + record.size]
        if self.verify and zlib.crc32(raw) != record.crc32:
            raise self._corrupt(number, "its checksum differs from the index")
        try:
            return _parse(record.key, raw, record.offset, shard)
        except (ValueError, KeyError, TypeError) as error:
            raise self._corrupt(number, f"it cannot be read ({error})") from error

    def _map(self, number: int, shard: int) -> Mapped:
        found = self._maps.get(shard)
        if found is None:
            record = self.shards[shard]
            try:
                with (self.index.root / record.file).open("rb") as file:
                    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except FileNotFoundError as error:
                raise self._corrupt(number, "the file is missing") from error
            except ValueError as error:
                raise self._corrupt(number, "the file is empty") from error
            with warnings.catch_warnings():  # torch warns of read-only memory; nothing here writes to it
                warnings.simplefilter("ignore", UserWarning)
                data = torch.frombuffer(mapped, dtype=torch.uint8, count=len(mapped) // 4 * 4)
            views = {dtype: data.view(dtype) for dtype in DTYPES.values()}
            found = self._maps[shard] = (mapped, views)
            if len(self._maps) > OPEN_FILES:
                self._maps.popitem(last=False)
        return found

    def _corrupt(self, number: int, what: str) -> CorruptSampleError:
        return CorruptSampleError(
            self.name(number),
            f"{self.name(number)}: {what}. The shard was altered or is not complete: copy it again or "
            f"prepare anew (trainer prepare FRAMES --output {self.index.root} --force); --data.on_corrupt "
            "skip leaves such samples out and counts them",
        )


def _parse(key: str, raw: memoryview, offset: int, shard: int) -> Sample:
    """Read the two tar headers and the JSON of a sample; `offset` is where `raw` begins in the file."""
    block = tarfile.BLOCKSIZE
    length = int(bytes(raw[124:135]), 8)
    meta = json.loads(bytes(raw[block : block + length]))
    start = offset + 2 * block + length + -length % block
    buffers = {}
    for entry in meta["buffers"]:
        dtype = DTYPES[entry["dtype"]]
        first = (start + entry["offset"]) // dtype.itemsize
        buffers[entry["name"]] = Stored(dtype, tuple(entry["shape"]), first)
    low, high = meta["depth_range"]
    aperture, focus, view = meta.get(THIN_LENS, (0.0, 0.0, 0.0))
    return Sample(
        key,
        meta["scene"],
        meta["frame"],
        meta["exposure"],
        (low, high),
        meta["accumulated"],
        meta["height"],
        meta["width"],
        shard,
        buffers,
        tuple(meta.get("sample_channels", ())),
        (aperture, focus, view),
    )
