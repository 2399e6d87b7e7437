"""Reads shards straight to a sample by the index, with checksums: through memory maps, or over the network.

Of shards at a URL whole copies are mapped as far as they are here already and the cache holds them
(`data.shards.cache`); samples of the others are read by themselves, in ranges of bytes. Where a server does
not give ranges, who wants a sample waits for its shard.
"""

from __future__ import annotations

import math
import mmap
import os
import sys
import warnings
import zlib
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable
from itertools import accumulate
from typing import IO, Any, NamedTuple

import torch
from torch import Tensor

from data import remote
from data.progress import size_text
from data.shards.cache import ShardCache
from data.shards.description import DTYPES, Sample, parse
from data.shards.index import Index
from data.shards.prefetch import Prefetcher

OPEN_FILES = 256
"""Shards mapped at one time by one process; a limit of 1024 open files is common."""

ATTEMPTS = 3
"""Times that a sample with a wrong checksum is read over the network."""


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


class _Held(NamedTuple):
    """Bytes in memory, a mapped shard or a sample alone, and all of them as a tensor of each type."""

    data: mmap.mmap | bytearray
    views: dict[torch.dtype, Tensor]


class ShardReader:
    """All samples of one split, numbered through its shards.

    Files are mapped on first use in each process, so a reader can be handed to worker processes.

    Args:
        index: Index of the folder.
        split: `train`, `validation` or `test`.
        verify: Compare each sample with its checksum when a process reads it for the first time; samples
            that are read over the network always are.
        cache: Copies of shards at a URL; needed where the index has one.
    """

    def __init__(
        self, index: Index, split: str, verify: bool = True, cache: ShardCache | None = None
    ) -> None:
        if index.url is not None and cache is None:
            raise ValueError(f"{index.place} is read through a cache, which is not given")
        self.index, self.split, self.verify, self.cache = index, split, verify, cache
        self.shards = index.of(split)
        sizes = [len(shard.samples) for shard in self.shards]
        self.shard_sizes = sizes
        self._first = [0, *accumulate(sizes)]
        self._forget()

    def __len__(self) -> int:
        return self._first[-1]

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in ("_maps", "_samples", "_pid", "_single", "_ranges", "_prefetcher"):
            del state[name]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    def _forget(self) -> None:
        self._pid = os.getpid()
        self._maps: OrderedDict[int, _Held] = OrderedDict()
        self._single: dict[int, _Held] = {}  # samples of the current batch that were read alone
        self._samples: dict[int, Sample] = {}
        self._ranges = True
        self._prefetcher: Prefetcher | None = None

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
        return f"{self._path(record.file)}, sample {record.samples[place].key}"

    def bytes_of(self, number: int) -> int:
        """Return the bytes of a sample in its shard."""
        shard, place = self.locate(number)
        return self.shards[shard].samples[place].size

    def begin(self, shards: Iterable[int]) -> None:
        """Begin a batch: forget samples that were read alone, and download the shards that come next.

        Args:
            shards: In the order in which they are needed; without meaning for shards on this machine.
        """
        if self.cache is None:
            return
        if self._pid != os.getpid():
            self._forget()
        self._single.clear()
        if self._prefetcher is None:
            self._prefetcher = Prefetcher(self.cache, self.shards)
        self._prefetcher.expect(number for number in shards if number not in self._maps)

    def close(self) -> None:
        """End the threads that download ahead; the next batch starts them again."""
        if self._prefetcher is not None:
            self._prefetcher.close()
            self._prefetcher = None

    def sample(self, number: int) -> Sample:
        """Return the description of a sample; verifies it when this process sees it for the first time.

        Raises:
            CorruptSampleError: The shard is missing or shorter than the index says, or the checksum differs.
            OSError: The shard lies at a URL that cannot be read.
        """
        if self._pid != os.getpid():
            self._forget()
        known = self._samples.get(number)
        if known is None:
            shard, place = self.locate(number)
            known = self._samples[number] = self._read(number, shard, place)
        return known

    def array(self, number: int, name: str) -> Tensor:
        """Return a stored array (C, H, W), `samples` (S, C, H, W), of a clip (N, C, H, W): a view, read-only,
        of the bytes of the file.

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
        held, offset = self._hold(number)
        strides = [math.prod(stored.shape[i + 1 :]) for i in range(len(stored.shape))]
        start = offset // stored.dtype.itemsize + stored.start
        return held.views[stored.dtype].as_strided(stored.shape, strides, start)

    def _path(self, file: str) -> str:
        url = self.index.url
        return str(self.index.root / file) if url is None else remote.shown(remote.join(url, file))

    def _read(self, number: int, shard: int, place: int) -> Sample:
        record = self.shards[shard].samples[place]
        held, offset = self._hold(number)
        if offset + record.size > len(held.data):
            raise self._corrupt(number, f"the file ends after {len(held.data)} bytes")
        raw = memoryview(held.data)[offset : offset + record.size]
        if self.verify and zlib.crc32(raw) != record.crc32:
            raise self._corrupt(number, "its checksum differs from the index")
        try:
            return parse(record.key, raw, shard)
        except ValueError as error:
            raise self._corrupt(number, f"it cannot be read ({error})") from error

    def _hold(self, number: int) -> tuple[_Held, int]:
        """Return bytes that hold a sample, and where it begins in them."""
        shard, place = self.locate(number)
        record = self.shards[shard].samples[place]
        found = self._maps.get(shard)
        if found is not None:
            return found, record.offset
        if number in self._single:
            return self._single[number], 0
        file = self._open(number, shard)
        if file is None:
            single = self._read_alone(number, shard) if self._ranges else None
            if single is not None:
                self._single[number] = single
                return single, 0
            file = self._wait_for(number, shard)
        return self._map(number, shard, file), record.offset

    def _open(self, number: int, shard: int) -> IO[bytes] | None:
        """Return the file of a shard; None: it lies at a URL and is not in the cache."""
        record = self.shards[shard]
        if self.cache is not None:
            return self.cache.open(record)
        try:
            return (self.index.root / record.file).open("rb")
        except FileNotFoundError as error:
            raise self._corrupt(number, "the file is missing") from error

    def _map(self, number: int, shard: int, file: IO[bytes]) -> _Held:
        with file:
            try:
                # The map keeps the file open, and with it the lock against removal from the cache.
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except ValueError as error:
                raise self._corrupt(number, "the file is empty") from error
        held = self._maps[shard] = _Held(mapped, _views(mapped))
        if len(self._maps) > OPEN_FILES:
            self._maps.popitem(last=False)
        return held

    def _read_alone(self, number: int, shard: int) -> _Held | None:
        """Return a sample that is read over the network; None where the server gives whole files only."""
        assert self.cache is not None
        where, place = self.shards[shard], self.locate(number)[1]
        record = where.samples[place]
        for _ in range(ATTEMPTS):
            try:
                data = remote.read_range(remote.join(self.cache.url, where.file), record.offset, record.size)
            except FileNotFoundError as error:
                raise self._corrupt(number, f"the file is missing ({error})") from error
            except ValueError as error:
                raise self._corrupt(number, str(error)) from error
            if data is None:
                self._say_whole()
                return None
            self.cache.count(len(data))
            if zlib.crc32(data) == record.crc32:
                copy = bytearray(data)
                return _Held(copy, _views(copy))
        raise self._corrupt(number, f"its checksum differs from the index, {ATTEMPTS} times")

    def _wait_for(self, number: int, shard: int) -> IO[bytes]:
        """Return the file of a shard, downloaded whatever else has to leave the cache."""
        assert self.cache is not None
        file: IO[bytes] | None = None
        while file is None:
            self._maps.clear()  # what this process has mapped makes room
            try:
                self.cache.add(self.shards[shard], wanted_now=True)
            except FileNotFoundError as error:
                raise self._corrupt(number, f"the file is missing ({error})") from error
            except ValueError as error:
                raise self._corrupt(number, str(error)) from error
            file = self.cache.open(self.shards[shard])
        return file

    def _say_whole(self) -> None:
        """Note that the server gives whole files only, and warn once where that will be slow."""
        assert self.cache is not None
        self._ranges = False
        size = sum(shard.bytes for shard in self.shards)
        if size > self.cache.limit:
            print(
                f"warning: the server of {self.index.place} gives whole files only, and the {self.split} "
                f"shards ({size_text(size)}) do not fit the cache ({size_text(self.cache.limit)}): they are "
                "downloaded over and over; raise --data.cache_gb",
                file=sys.stderr,
                flush=True,
            )

    def _corrupt(self, number: int, what: str) -> CorruptSampleError:
        return CorruptSampleError(
            self.name(number),
            f"{self.name(number)}: {what}. The shard was altered or is not complete: copy it again or "
            f"prepare anew (trainer prepare FRAMES --output {self.index.place} --force); --data.on_corrupt "
            "skip leaves such samples out and counts them",
        )


def _views(data: mmap.mmap | bytearray) -> dict[torch.dtype, Tensor]:
    with warnings.catch_warnings():  # torch warns of read-only memory; nothing here writes to it
        warnings.simplefilter("ignore", UserWarning)
        whole = torch.frombuffer(data, dtype=torch.uint8, count=len(data) // 4 * 4)
    return {dtype: whole.view(dtype) for dtype in DTYPES.values()}
