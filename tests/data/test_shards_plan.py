from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from data.shards.plan import batches_per_epoch, evaluation_samples, training_epoch

SIZES = [8, 8, 8, 5, 7, 3]


@pytest.mark.parametrize("world", [1, 2, 3, 6])
@pytest.mark.parametrize("batch_size", [1, 3, 4])
def test_every_rank_gets_the_same_number_of_full_batches(world: int, batch_size: int):
    shapes = {training_epoch(SIZES, 1, 0, rank, world, batch_size).shape for rank in range(world)}
    assert shapes == {(sum(SIZES) // (world * batch_size), batch_size)}


@pytest.mark.parametrize("world", [1, 2, 3, 6])
def test_ranks_never_share_a_sample_and_read_whole_shards(world: int):
    first = np.cumsum([0, *SIZES])
    for epoch in range(5):
        seen = [set(training_epoch(SIZES, 1, epoch, rank, world, 1).ravel()) for rank in range(world)]
        assert sum(map(len, seen)) == len(set().union(*seen))
        owners = [{int(np.searchsorted(first, s, "right")) for s in mine} for mine in seen]
        assert sum(map(len, owners)) == len(set().union(*owners))


def test_one_rank_sees_every_sample_once_in_an_epoch():
    assert sorted(training_epoch(SIZES, 1, 4, 0, 1, 1).ravel()) == list(range(sum(SIZES)))


def test_samples_that_do_not_fill_a_batch_differ_from_epoch_to_epoch():
    left = [set(range(39)) - set(training_epoch(SIZES, 1, epoch, 0, 1, 4).ravel()) for epoch in range(8)]
    assert all(len(part) == 3 for part in left)
    assert all(a != b for a, b in pairwise(left))


def test_over_the_epochs_every_rank_sees_every_sample():
    for rank in range(2):
        seen = {s for epoch in range(30) for s in training_epoch(SIZES, 1, epoch, rank, 2, 4).ravel()}
        assert seen == set(range(39))


def test_a_rank_with_fewer_samples_starts_over_in_its_own_order():
    found = [training_epoch([10, 2], 1, epoch, rank, 2, 3) for epoch in range(8) for rank in range(2)]
    short = next(f.ravel() for f in found if set(f.ravel()) <= {10, 11})
    assert list(short) == [short[0], short[1]] * 3


def test_the_order_repeats_for_a_seed_and_differs_by_epoch_and_seed():
    order = training_epoch(SIZES, 1, 2, 0, 2, 4)
    assert np.array_equal(order, training_epoch(SIZES, 1, 2, 0, 2, 4))
    assert not np.array_equal(order, training_epoch(SIZES, 1, 3, 0, 2, 4))
    assert not np.array_equal(order, training_epoch(SIZES, 2, 2, 0, 2, 4))


def test_fewer_shards_than_ranks_is_an_error_that_says_how_to_prepare():
    with pytest.raises(ValueError, match=r"2 training shards for 3 ranks.*--samples-per-shard 3"):
        batches_per_epoch([10, 10], 3, 1)


def test_fewer_samples_than_a_batch_per_rank_is_an_error():
    with pytest.raises(
        ValueError, match="7 training samples are fewer than one batch of 4 on each of 2 ranks"
    ):
        batches_per_epoch([4, 3], 2, 4)


@pytest.mark.parametrize("total", [0, 1, 5, 24])
@pytest.mark.parametrize("world", [1, 2, 3, 8])
def test_evaluation_sees_every_sample_once_over_all_ranks(total: int, world: int):
    parts = [evaluation_samples(total, rank, world) for rank in range(world)]
    assert sorted(np.concatenate(parts)) == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
