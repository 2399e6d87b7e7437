"""Loaders that Lightning can resume in the middle of an epoch and that it leaves as they are.

They are no `torch.utils.data.DataLoader` but hold one, so Lightning neither replaces their sampler under DDP
nor builds them anew. What is read follows from (epoch, batch) alone; a worker gets the list of samples of
whole batches and keeps no state.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Sampler

from data.shards.batch import Batches, Order
from data.shards.index import ShardRecord
from data.shards.packed import Batch, Packed
from data.shards.plan import batches_per_epoch, evaluation_samples, shards_ahead, training_epoch

logger = logging.getLogger("data")


def _unchanged(item: Any) -> Any:
    return item


class _Orders(Sampler[Order]):
    """The batches of one pass, as a sampler; `items` is set before each."""

    def __init__(self) -> None:
        self.items: list[Order] = []

    def __iter__(self) -> Iterator[Order]:
        return iter(self.items)

    def __len__(self) -> int:
        return len(self.items)


class _Loader:
    """What both loaders share: a DataLoader that is made on first use, and the count of damaged samples.

    Args:
        batches: The data set.
        workers: Worker processes; 0 reads in this process.
        pin_memory: Deliver page-locked memory, for copies to a GPU.
    """

    def __init__(self, batches: Batches, workers: int, pin_memory: bool) -> None:
        self.batches, self.workers, self.pin_memory = batches, workers, pin_memory
        self.corrupt: dict[str, str] = {}
        self.waited_s = 0.0  # seconds that callers have waited for batches so far
        self.read_bytes = self.downloaded_bytes = 0  # of this rank so far; see `Packed`
        self._orders = _Orders()
        self._inner: DataLoader | None = None

    def _read(self, orders: list[Order]) -> Iterator[Batch]:
        self._orders.items = orders
        if self._inner is None:
            self._inner = DataLoader(
                self.batches,
                batch_size=None,
                sampler=self._orders,
                collate_fn=_unchanged,
                num_workers=self.workers,
                persistent_workers=self.workers > 0,
                pin_memory=self.pin_memory,
                # Its own, so that reading does not advance the random state of the run.
                generator=torch.Generator(),
            )
        for packed in self._timed(self._inner):
            if packed.error is not None:
                raise packed.error
            for sample, reason in packed.corrupt:
                if sample not in self.corrupt:
                    self.corrupt[sample] = reason
                    warnings.warn(f"left out ({len(self.corrupt)} so far): {reason}", stacklevel=2)
            self.read_bytes += packed.read
            self.downloaded_bytes += packed.downloaded
            if packed.samples:
                yield packed.unpack()

    def _timed(self, loader: DataLoader) -> Iterator[Packed]:
        began = time.perf_counter()
        for packed in loader:
            self.waited_s += time.perf_counter() - began
            yield packed
            began = time.perf_counter()

    @property
    def remote(self) -> bool:
        """Whether the shards lie at a URL."""
        return self.batches.reader.cache is not None

    def _orders_of(self, epoch: int, batches: list[list[int]]) -> list[Order]:
        ahead: list[tuple[int, ...]] = [()] * len(batches)
        if self.remote:
            ahead = shards_ahead(self.batches.reader.shard_sizes, batches)
        return [Order(epoch, tuple(batch), coming) for batch, coming in zip(batches, ahead, strict=True)]

    def close(self) -> None:
        """End the worker processes and what downloads ahead; iterating starts them again."""
        self._inner = None
        self.batches.reader.close()


class _EpochTarget(NamedTuple):
    sampler: TrainingLoader


class TrainingLoader(_Loader):
    """Batches of shuffled training samples of one rank.

    Args:
        batches: The training samples.
        batch_size: Samples per batch.
        seed: Seed of the order.
        rank: This process.
        world: Number of processes.
        workers: Worker processes.
        pin_memory: Deliver page-locked memory.
        done: Returns the number of batches of this epoch that the trainer has finished; asked when the first
            batch of a pass is wanted. Without it, the position comes from `load_state_dict`.
        fixed_order: The order of the first epoch in every epoch.

    Raises:
        ValueError: Fewer shards than ranks, or not enough samples.
    """

    def __init__(
        self,
        batches: Batches,
        batch_size: int,
        seed: int,
        *,
        rank: int = 0,
        world: int = 1,
        workers: int = 0,
        pin_memory: bool = False,
        done: Callable[[], int] | None = None,
        fixed_order: bool = False,
    ) -> None:
        super().__init__(batches, workers, pin_memory)
        self.batch_size, self.seed, self.rank, self.world = batch_size, seed, rank, world
        self.fixed_order = fixed_order
        self.length = batches_per_epoch(batches.reader.shard_sizes, world, batch_size)
        self.left_out = len(batches) - self.length * world * batch_size
        self.epoch, self.position = 0, 0
        self._done = done
        self._start: tuple[int, int] | None = None
        if self.left_out:
            logger.info(
                "%d of %d training samples do not fill a batch and are left out, others in each epoch",
                self.left_out,
                len(batches),
            )

    @property
    def batch_sampler(self) -> _EpochTarget:
        """Where Lightning looks for a sampler whose epoch it sets."""
        return _EpochTarget(self)

    def set_epoch(self, epoch: int) -> None:
        """Name the epoch that the next pass belongs to."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Batch]:
        # A generator: epoch and position are looked up when the first batch is wanted, which is after
        # Lightning has restored its progress and named the epoch. It asks for iterators earlier than that.
        epoch, start = self._begin()
        shuffled = training_epoch(
            self.batches.reader.shard_sizes,
            self.seed,
            0 if self.fixed_order else epoch,
            self.rank,
            self.world,
            self.batch_size,
        )
        self.position = start
        for batch in self._read(self._orders_of(epoch, shuffled[start:].tolist())):
            self.position += 1
            yield batch

    def _begin(self) -> tuple[int, int]:
        if self._done is not None:
            return self.epoch, self._done()
        if self._start is None:
            return self.epoch, 0
        epoch, batch = self._start
        self._start = None
        if epoch == self.epoch:
            return epoch, batch
        return self.epoch, 0

    def state_dict(self) -> dict[str, Any]:
        """Return where this pass stands and what the order depends on."""
        return {"epoch": self.epoch, "batch": self.position, **self._identity()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken; warns if the order cannot be the same any more."""
        now = self._identity()
        changed = [f"{key} {state_dict[key]} → {now[key]}" for key in now if state_dict.get(key) != now[key]]
        if changed and 0 < state_dict["batch"] < self.length:
            warnings.warn(
                f"resuming in the middle of an epoch with other data or options ({', '.join(changed)}): what "
                "is left of this epoch is not what it would have been",
                stacklevel=2,
            )
        self.epoch = state_dict["epoch"]
        if state_dict["batch"] >= self.length:
            self.epoch += 1
            self._start = None
        else:
            self._start = (self.epoch, state_dict["batch"])

    def _identity(self) -> dict[str, Any]:
        index = self.batches.reader.index
        return {
            "seed": self.seed,
            "batch_size": self.batch_size,
            "ranks": self.world,
            "samples": len(self.batches),
            "manifest": index.manifest_hash[:12],
        }


class EvaluationLoader(_Loader):
    """Every sample of a split once over all ranks, in the order of the shards.

    A rank without a sample that can be read reads one of another all the same, since it must take part in the
    sums of all ranks; its batch has no `scene` and no `key`, so that it counts nowhere.

    Args:
        batches: The samples.
        batch_size: Samples per batch; the last one may be smaller. 1 for whole frames.
        rank: This process.
        world: Number of processes.
        workers: Worker processes.
        pin_memory: Deliver page-locked memory.
        whole_scenes: All samples of a scene go to one rank, instead of each sample to the next.
    """

    def __init__(
        self,
        batches: Batches,
        batch_size: int,
        *,
        rank: int = 0,
        world: int = 1,
        workers: int = 0,
        pin_memory: bool = False,
        whole_scenes: bool = False,
    ) -> None:
        super().__init__(batches, workers, pin_memory)
        scenes = _scene_sizes(batches.reader.shards) if whole_scenes else None
        mine = evaluation_samples(len(batches), rank, world, scenes).tolist()
        self.orders = self._orders_of(0, [mine[i : i + batch_size] for i in range(0, len(mine), batch_size)])

    def __len__(self) -> int:
        return max(1, len(self.orders))

    def __iter__(self) -> Iterator[Batch]:
        served = False
        for batch in self._read(self.orders):
            served = True
            yield batch
        if served:
            return
        for batch in self._read(self._orders_of(0, [[number] for number in range(len(self.batches))])):
            batch["scene"], batch["key"] = [], []
            yield batch
            return


def _scene_sizes(shards: Sequence[ShardRecord]) -> list[int]:
    """Return the number of samples of each scene, in the order of the shards."""
    return [
        sum(len(shard.samples) for shard in group)
        for _, group in groupby(shards, key=lambda shard: shard.scene)
    ]
