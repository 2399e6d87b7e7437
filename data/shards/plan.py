"""Who reads what, and when: samples of an epoch for each rank, without any state.

Everything here is a function of (seed, epoch, rank, world size), so a run that stops in the middle of an
epoch continues with the next batch, and the order does not depend on the number of workers, which take whole
batches in turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

AHEAD, LOOK = 32, 256
"""Shards that are downloaded ahead, at most, and batches that are looked at for them."""


def batches_per_epoch(shard_sizes: Sequence[int], world: int, batch_size: int) -> int:
    """Return the number of training batches that every rank sees in an epoch.

    It is total // (world * batch_size). The samples that are left over, fewer than world * batch_size, differ
    from epoch to epoch since each shuffles anew.

    Args:
        shard_sizes: Number of samples of each shard.
        world: Number of ranks.
        batch_size: Samples per batch and rank.

    Raises:
        ValueError: Fewer shards than ranks, or fewer samples than one batch for each rank.
    """
    total = sum(shard_sizes)
    if len(shard_sizes) < world:
        raise ValueError(
            f"{len(shard_sizes)} training shards for {world} ranks; every rank needs one of its own: prepare "
            f"again with smaller shards, --samples-per-shard {max(1, total // (2 * world))}, or use fewer "
            "devices"
        )
    if total < world * batch_size:
        raise ValueError(
            f"{total} training samples are fewer than one batch of {batch_size} on each of {world} ranks; "
            "use a smaller batch_size, or prepare again with a larger --train-patches"
        )
    return total // (world * batch_size)


def training_epoch(
    shard_sizes: Sequence[int], seed: int, epoch: int, rank: int, world: int, batch_size: int
) -> Indices:
    """Return the samples of one rank in one epoch, (batches, batch_size).

    Shards are shuffled and dealt to the ranks in turn; each rank shuffles all samples of its shards. Ranks
    see different shards, so no sample is seen by two of them. A rank with fewer samples than it has places
    starts over at the beginning of its order; one with more leaves out the end.

    Args:
        shard_sizes: Number of samples of each shard; sample numbers count through the shards.
        seed: Seed of the run.
        epoch: Number of the epoch, from 0.
        rank: This process.
        world: Number of ranks.
        batch_size: Samples per batch and rank.

    Raises:
        ValueError: As `batches_per_epoch`.
    """
    batches = batches_per_epoch(shard_sizes, world, batch_size)
    first = np.concatenate([[0], np.cumsum(shard_sizes)]).astype(np.int64)
    deal = _generator(seed, epoch, 0).permutation(len(shard_sizes))
    mine = np.sort(deal[rank::world])
    samples = np.concatenate([np.arange(first[shard], first[shard + 1]) for shard in mine])
    if len(samples) == 0:
        raise ValueError(f"the shards of rank {rank} hold no samples; prepare the data set again")
    samples = _generator(seed, epoch, 1, rank).permutation(samples)
    return np.resize(samples, (batches, batch_size))


def evaluation_samples(total: int, rank: int, world: int, scenes: Sequence[int] | None = None) -> Indices:
    """Return the samples of one rank in an evaluation, ascending: every sample once over all ranks.

    Ranks may get one more or one less; nothing is repeated to make them even.

    Args:
        total: Number of samples.
        rank: This process.
        world: Number of ranks.
        scenes: Number of samples of each scene, one scene after the other. Where given, a rank gets whole
            scenes, the largest first and each to who has the fewest samples so far; with fewer scenes than
            ranks some get none.
    """
    if scenes is None:
        return np.arange(rank, total, world, dtype=np.int64)
    ends = np.cumsum(scenes)
    assert total == (ends[-1] if len(ends) else 0)
    given, mine = [0] * world, np.zeros(total, bool)
    for scene in sorted(range(len(scenes)), key=lambda scene: -scenes[scene]):
        owner = given.index(min(given))
        given[owner] += scenes[scene]
        mine[ends[scene] - scenes[scene] : ends[scene]] = owner == rank
    return np.flatnonzero(mine).astype(np.int64)


def shards_ahead(shard_sizes: Sequence[int], batches: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
    """Return for each batch the shards that it and the batches after it need next, `AHEAD` at most.

    Args:
        shard_sizes: Number of samples of each shard; sample numbers count through the shards.
        batches: Numbers of the samples of each batch, in order.
    """
    ends = np.cumsum(shard_sizes)
    shards = [np.searchsorted(ends, batch, side="right").tolist() for batch in batches]
    ahead = []
    for number in range(len(shards)):
        found: dict[int, None] = {}
        for later in shards[number : number + LOOK]:
            found.update(dict.fromkeys(later))
            if len(found) >= AHEAD:
                break
        ahead.append(tuple(found)[:AHEAD])
    return ahead


def _generator(*words: int) -> np.random.Generator:
    return np.random.Generator(
        np.random.PCG64(np.random.SeedSequence([word & (2**63 - 1) for word in words]))
    )
