import math
import random
from pathlib import Path

import pytest

from tests.trainer.benchmarking.stand_ins import Stand
from trainer.benchmarking import pairing
from trainer.benchmarking.cases import Case, Effort, Method
from trainer.benchmarking.measuring import Exports, Watcher
from trainer.benchmarking.pairing import Contestant, compare, student_interval
from trainer.benchmarking.table import comparison_lines, remarks

MADE = Exports(Path("unused"))


@pytest.fixture
def stand(monkeypatch):
    for name, value in {"seconds": {"A": 1.0, "B": 1.0}, "failing": {}, "drift": 0.0, "noise": 0.0,
                        "calls": [], "random": random.Random(1)}.items():  # fmt: skip
        monkeypatch.setattr(Stand, name, value)
    monkeypatch.setattr(pairing, "Measuring", Stand)
    return Stand


def compared(rounds=4, processes=5):
    sides = [Contestant(name, Case(Method(name)), MADE) for name in "AB"]
    return compare(*sides, Effort(rounds, 1, 60), processes, Watcher())


def test_a_method_that_takes_twice_as_long_has_the_ratio_2(stand):
    stand.seconds |= {"B": 2.0}
    stand.drift = stand.noise = 0.01
    found = compared()
    assert found.ratio == pytest.approx(2, rel=0.03)
    assert found.significant
    assert "B is significantly slower" in comparison_lines(found)[0]


def test_the_two_take_turns_and_the_order_changes_from_pair_to_pair(stand):
    compared(rounds=1, processes=3)
    turns = "".join(stand.calls)
    assert turns == "ABABBA" + "BABAAB" + "ABABBA"  # a call of each to learn its length, then the round


def test_a_load_that_grows_steadily_does_not_change_the_ratio(stand, monkeypatch):
    def times(self, calls):
        stand.calls.append(self.model)
        return [1 + 0.01 * len(stand.calls)] * calls

    monkeypatch.setattr(stand, "times", times)
    assert compared(rounds=6).ratio == pytest.approx(1, abs=1e-3)


def test_equal_methods_are_rarely_told_apart_although_processes_differ(stand):
    stand.drift, stand.noise = 0.02, 0.01
    found = [compared(rounds=3) for _ in range(300)]
    wrong = sum(one.significant for one in found) / len(found)
    assert wrong == pytest.approx(0.05, abs=0.03)


def test_the_interval_is_that_of_student():
    low, high = student_interval([math.exp(value) for value in (-1.0, 0.0, 1.0)])
    assert math.log(high) == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)
    assert low == pytest.approx(1 / high)


def test_where_one_fails_its_reason_is_told_once_and_there_is_no_ratio(stand):
    stand.failing |= {"B": "no CUDA device"}
    found = compared()
    assert not found.done
    told = remarks(found.sides) + comparison_lines(found)
    assert told == ["A: not without the other", "B: no CUDA device"]
    assert "ratio" not in found.row()


def test_figures_of_both_are_kept(stand):
    stand.seconds |= {"A": 0.5}
    row = compared(rounds=2, processes=3).row()
    assert [side["median_seconds"] for side in row["sides"]] == [0.5, 1.0]
    assert len(row["sides"][0]["seconds"]) == 2 * 2 * 3
    assert row["ratios"] == pytest.approx([2.0] * 3)
