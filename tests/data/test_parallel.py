"""Work in several processes: order, errors, what is sent, and processes that end."""

import os
import pickle
from functools import partial

import pytest

from data.parallel import MOST_TOGETHER, groups, results

PICKLED = []


class Shared:
    """Counts how often it is sent, in the process that sends it."""

    def __reduce__(self):
        PICKLED.append(1)
        return (Shared, ())


def with_shared(shared, number):
    return number, os.getpid()


def fails(number):
    if number == 3:
        raise ValueError("frame 3 is damaged")
    return number


def ends(number):
    os._exit(7)


def test_what_all_calls_share_is_sent_once_per_process_and_not_per_thing():
    PICKLED.clear()
    found = dict(results(partial(with_shared, Shared()), range(200), 2))
    assert [found[n][0] for n in range(200)] == list(range(200))
    assert len(PICKLED) <= 2
    assert os.getpid() not in {pid for _, pid in found.values()}


def test_neighbours_go_to_one_process_and_small_jobs_stay_single():
    many = groups(range(20_000), 2)
    assert {len(g) for g in many[:-1]} == {MOST_TOGETHER}
    assert [n for g in many for n in g] == list(range(20_000))
    assert {len(g) for g in groups(range(30), 2)} == {1}
    assert len(pickle.dumps(many[0])) < 100


def test_one_process_works_here_and_in_order():
    assert list(results(fails, [1, 2], 1)) == [(1, 1), (2, 2)]
    assert list(results(fails, [], 4)) == []


def test_the_first_error_and_a_process_that_ends_are_raised():
    with pytest.raises(ValueError, match="frame 3 is damaged"):
        list(results(fails, range(5), 2))
    with pytest.raises(OSError, match="ended from outside"):
        list(results(ends, range(5), 2))
