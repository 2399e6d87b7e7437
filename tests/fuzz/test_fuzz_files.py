from __future__ import annotations

import importlib

import pytest

from tests.fuzz import batches
from tests.fuzz.__main__ import FORMATS

COUNTS = {"exr": 400, "checkpoints": 250, "artifacts": 100, "records": 400}


@pytest.mark.parametrize("name", COUNTS)
def test_altered_files_are_read_or_refused_and_never_more(name):
    outcome = batches.measure(name, COUNTS[name], seed=11)
    assert outcome.violations == []
    assert sum(outcome.counts.values()) == COUNTS[name]
    assert min(outcome.counts["read"], outcome.counts["refused"]) > 10
    assert 0 < outcome.share <= 1


@pytest.mark.parametrize("name", COUNTS)
def test_an_input_can_be_made_again(name):
    module = importlib.import_module(f"tests.fuzz.{name}")
    made = module.bases()
    assert module.mutated(made, 1, 17) == module.mutated(made, 1, 17)
    assert len({str(module.mutated(made, 1, number)) for number in range(8)}) > 4


def test_every_format_is_in_the_table():
    assert {*COUNTS, "shards"} == set(FORMATS)
