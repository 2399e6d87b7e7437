from __future__ import annotations

from tests.fuzz import shards


def test_altered_shards_are_read_or_refused_and_never_more():
    outcomes = shards.run(300, seed=3)
    assert sum(outcomes.values()) == 300
    assert min(outcomes["read"], outcomes["refused"]) > 20


def test_an_input_can_be_made_again():
    made = shards.bases()
    assert shards.mutated(made, 1, 17) == shards.mutated(made, 1, 17)
    assert shards.mutated(made, 1, 17) != shards.mutated(made, 1, 18)
