"""The softmax over all that reaches a pixel, one sample at a time."""

from __future__ import annotations

from functools import reduce

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.ops import kernel_blocks
from models.ops.arrivals import Outside, gathered, merge, splat_softmax, splatted, with_outside
from models.ops.gather import pad_border
from tests.models.ops.test_splat import close, made
from tests.models.plain_splat import plain_gather_samples, plain_splat_softmax

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(params=[1, 60, 1 << 14], ids=["row by row", "some rows", "at once"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_blocks, "_CHUNK", request.param)


def one_by_one(values: Tensor, logits: Tensor, size: int, outside: Outside = "weigh") -> Tensor:
    parts = [
        splatted(v[:, None], w[:, None], size)
        for v, w in zip(values.unbind(1), logits.unbind(1), strict=True)
    ]
    sums = reduce(merge, parts)
    return (with_outside(sums, size, len(parts)) if outside == "weigh" else sums).mean()


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("outside", ["weigh", "drop"])
@pytest.mark.parametrize("size", [1, 5, 9])
def test_it_equals_a_list_of_all_contributions(size: int, outside: Outside) -> None:
    values, logits = made(size, 5, 6)
    logits = logits * 200  # without the maximum at the pixel exp overflows, or vanishes everywhere
    expected = plain_splat_softmax(values, logits, size, outside == "weigh")
    torch.testing.assert_close(splat_softmax(values, logits, size, outside), expected)
    torch.testing.assert_close(one_by_one(values, logits, size, outside), expected)


def test_the_order_of_samples_does_not_matter() -> None:
    values, logits = made(5)
    back = one_by_one(values.flip(1), logits.flip(1), 5)
    torch.testing.assert_close(back, one_by_one(values, logits, 5), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("outside", ["weigh", "drop"])
def test_gradients_of_samples_at_once_and_one_by_one_are_those_of_finite_differences(
    outside: Outside,
) -> None:
    values, logits = (t.requires_grad_() for t in made(3, 3, 2, 2, 1, 1))
    assert torch.autograd.gradcheck(lambda v, w: splat_softmax(v, w, 3, outside), (values, logits))
    assert torch.autograd.gradcheck(lambda v, w: one_by_one(v, w, 3, outside), (values, logits))


@pytest.mark.parametrize("size", [3, 5])
def test_rows_beyond_the_image_are_those_of_a_taller_image_that_sends_nothing_from_them(size: int) -> None:
    values, logits = made(size)
    margin = (0, 0, size // 2, size // 2)
    taller = splatted(F.pad(values, margin), F.pad(logits, margin, value=-1e4), size)
    close(splatted(values, logits, size, beyond=True), taller)


def test_a_constant_stays_constant_unless_what_lies_outside_takes_weight() -> None:
    values, logits = made(5, 12, 12)
    values = torch.full_like(values, 3.0)
    torch.testing.assert_close(splat_softmax(values, logits, 5, "drop"), values[:, 0])
    weighed = splat_softmax(values, logits, 5)
    torch.testing.assert_close(weighed[..., 2:-2, 2:-2], values[:, 0, :, 2:-2, 2:-2])
    assert (weighed[..., :2, :] < 2.9).all()


@pytest.mark.parametrize("size", [1, 5])
def test_gathers_of_samples_are_one_softmax_over_samples_and_neighbours(size: int) -> None:
    values, logits = (t.requires_grad_() for t in made(size))
    sums = reduce(
        merge,
        [gathered(pad_border(values[:, n], size // 2, "zero"), logits[:, n] * 30, size) for n in range(3)],
    )
    expected = plain_gather_samples(values, logits * 30, size)
    torch.testing.assert_close(sums.mean(0.0), expected)
    weights = torch.rand_like(expected)
    found = torch.autograd.grad((sums.mean(0.0) * weights).sum(), (values, logits))
    close(found, torch.autograd.grad((expected * weights).sum(), (values, logits)), 1e-9)


class Traced(nn.Module):
    def forward(self, values: Tensor, logits: Tensor) -> tuple[Tensor, ...]:
        own = gathered(pad_border(values[:, 0], 2, "zero"), logits[:, 0], 5).mean()
        beyond = splatted(values, logits, 5, beyond=True).mean()
        return splat_softmax(values, logits, 5), splat_softmax(values, logits, 5, "drop"), own, beyond


def test_a_traced_softmax_runs_at_another_size_and_number_of_samples() -> None:
    with torch.no_grad(), pytest.warns(DeprecationWarning, match="torch.jit.trace"):
        traced = torch.jit.trace(Traced(), tuple(t.float() for t in made(5)), check_trace=False)
    other = tuple(t.float() * 20 for t in made(5, 11, 8, count=5, batch=1))
    close(traced(*other), Traced()(*other), 1e-4)
