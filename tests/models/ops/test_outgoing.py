"""Samples that are splatted group by group arrive as all at once."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops.outgoing import send
from models.ops.splat import splat_exp

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")


def samples(count: int, size: int, channels: int = 4) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    values = torch.rand(2, count, channels, 6, 7, generator=generator, dtype=torch.float64)
    logits = torch.randn(2, count, size * size, 6, 7, generator=generator, dtype=torch.float64)
    return values, logits * torch.linspace(1, 30, count)[
        :, None, None, None
    ]  # later ones bring larger maxima


@pytest.mark.parametrize("size", [1, 3, 5])
@pytest.mark.parametrize("group", [1, 2, 7])
@pytest.mark.parametrize("beyond", [False, True])
def test_groups_of_samples_arrive_as_all_at_once(size: int, group: int, beyond: bool) -> None:
    values, logits = samples(5, size)
    expected = splat_exp(values, logits, size, beyond=beyond).total
    sums = None
    for some in zip(values.split(group, 1), logits.clone().split(group, 1), strict=True):
        sums = send(sums, *some)
    assert sums is not None
    torch.testing.assert_close(sums.arrived(size, beyond), expected, rtol=1e-12, atol=1e-14)


def test_samples_that_never_count_leave_no_trace_in_any_order() -> None:
    values, logits = samples(3, 3)
    expected = splat_exp(values[:, 1:], logits[:, 1:], 3).total
    values[:, 0], logits[:, 0] = 0.0, logits[:, 0] - 1e30
    for order in ([0, 1, 2], [1, 2, 0], [1, 0, 2]):
        sums = None
        for number in order:
            sums = send(sums, values[:, number, None], logits[:, number, None].clone())
        assert sums is not None
        torch.testing.assert_close(sums.arrived(3), expected, rtol=1e-12, atol=1e-14)


def test_what_pixels_send_has_no_more_numbers_for_more_samples() -> None:
    few, many = (send(None, *samples(count, 3)) for count in (2, 40))
    assert few.taps.shape == many.taps.shape == (2, 4, 9, 6, 7)
