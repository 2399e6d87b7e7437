"""A network of comparisons sorts whatever it is given."""

from __future__ import annotations

import itertools

import pytest
import torch

from models.ops.sorting import comparisons, in_order


@pytest.mark.parametrize("count", [1, 2, 3, 5, 9, 12])
def test_all_sequences_of_zeros_and_ones_are_sorted_and_so_is_everything(count: int) -> None:
    # A network that sorts these sorts all numbers (the 0-1 principle).
    cases = torch.tensor(list(itertools.product((0.0, 1.0), repeat=count)))
    found = torch.stack(in_order(list(cases.T)))
    assert torch.equal(found, cases.T.sort(0).values)


def test_sixteen_images_are_sorted_by_63_comparisons() -> None:
    images = torch.rand(16, 2, 500, generator=torch.Generator().manual_seed(1))
    assert torch.equal(torch.stack(in_order(list(images))), images.sort(0).values)
    assert len(list(comparisons(16))) == 63
