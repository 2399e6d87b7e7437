"""Splats equal the loop over samples, pixels and offsets, with their gradients, and are gathers' adjoints."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.ops import kernel_blocks
from models.ops.gather_inside import gather_inside, gather_weighted
from models.ops.splat import (
    Splatted,
    splat,
    splat_apart,
    splat_exp,
    splat_shifted,
)
from tests.benchmarks.memory import peak_bytes
from tests.models.plain_splat import fold_gather, fold_splat, plain_splat

pytestmark = pytest.mark.usefixtures("one_thread")


def made(
    size: int, height: int = 6, width: int = 7, count: int = 3, channels: int = 2, batch: int = 2
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(size * height)
    values = torch.rand(batch, count, channels, height, width, generator=generator, dtype=torch.float64)
    shape = (batch, count, size * size, height, width)
    return values, torch.randn(shape, generator=generator, dtype=torch.float64)


@pytest.fixture(params=[1, 60, 1 << 14], ids=["row by row", "some rows", "at once"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_blocks, "_CHUNK", request.param)


def close(found: tuple[Tensor, ...], expected: tuple[Tensor, ...], bound: float = 1e-11) -> None:
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=bound, atol=bound)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize(("size", "height", "width"), [(1, 3, 4), (3, 6, 7), (5, 4, 3), (7, 2, 9), (9, 1, 1)])
def test_a_splat_equals_the_loop_over_samples_pixels_and_offsets(size: int, height: int, width: int) -> None:
    values, weights = made(size, height, width)
    close(splat(values, weights, size), plain_splat(values, weights, size))


@pytest.mark.parametrize("size", [17, 21])
def test_large_kernels_equal_products_folded(size: int) -> None:
    values, weights = made(size, 24, 31)
    close(splat(values, weights, size), fold_splat(values, weights, size))
    single = splat(values.float(), weights.float(), size)
    close(single, fold_splat(values.float(), weights.float(), size), 1e-4)


@pytest.mark.parametrize("size", [3, 17])
def test_an_impulse_spreads_into_its_pixels_kernel(size: int) -> None:
    reach, side = size // 2, size + 4
    values, weights = torch.zeros(1, 1, 1, side, side), torch.rand(1, 1, size * size, side, side)
    values[..., reach + 1, reach + 2] = 2.0
    total = splat(values, weights, size).total
    expected = torch.zeros_like(total)
    kernel = weights[0, 0, :, reach + 1, reach + 2].reshape(size, size)
    expected[0, 0, 1 : 1 + size, 2 : 2 + size] = 2.0 * kernel
    torch.testing.assert_close(total, expected)


def test_one_pixel_by_hand() -> None:
    values = torch.tensor([[[[[5.0, 0, 0], [0, 0, 0], [0, 0, 0]]]]])
    weights = torch.zeros(1, 1, 9, 3, 3)
    weights[0, 0, 5, 0, 0] = 0.5  # to the right
    weights[0, 0, 6, 0, 0] = 7.0  # below to the left: outside
    weights[0, 0, 7, 0, 0] = 0.25  # below
    found = splat(values, weights, 3)
    assert found.total[0, 0].tolist() == [[0, 2.5, 0], [1.25, 0, 0], [0, 0, 0]]
    assert found.weight[0, 0].tolist() == [[0, 0.5, 0], [0.25, 0, 0], [0, 0, 0]]


@pytest.mark.usefixtures("chunk")
def test_rows_beyond_the_image_are_those_of_a_taller_image_in_values_and_gradients() -> None:
    values, logits = (t.requires_grad_() for t in made(5))
    margin = (0, 0, 2, 2)
    shift = torch.rand(2, 1, 10, 7, dtype=torch.float64)
    own = logits.amax((1, 2), keepdim=True)
    tall = [F.pad(values, margin), F.pad(logits, margin, value=-100.0), F.pad(own, margin)]
    pairs = [
        (splat(values, logits, 5, beyond=True), splat(tall[0], F.pad(logits, margin), 5)),
        (splat_exp(values, logits, 5, beyond=True), splat_exp(*tall[:2], 5, tall[2])),
        (splat_shifted(values, logits, 5, shift, True), splat_shifted(*tall[:2], 5, shift)),
    ]
    for found, expected in pairs:
        close(found, expected)
        close(
            *(
                torch.autograd.grad(loss(made), (values, logits), retain_graph=True)
                for made in (found, expected)
            )
        )


@pytest.mark.parametrize("size", [1, 3, 17])
def test_splat_and_gather_are_adjoint(size: int) -> None:
    values, weights = made(size, 9, 22, count=1)
    image = torch.rand_like(values[:, 0])
    there = (splat(values, weights, size).total * image).sum()
    back = (values[:, 0] * gather_weighted(image, weights[:, 0], size)).sum()
    assert there.item() == pytest.approx(back.item(), rel=1e-12)


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("size", [1, 5, 21])
def test_a_weighted_gather_equals_unfold_and_sum(size: int) -> None:
    values, weights = made(size, 8, 25, count=1)
    expected = fold_gather(values[:, 0], weights[:, 0], size)
    torch.testing.assert_close(gather_weighted(values[:, 0], weights[:, 0], size), expected)


def test_gathering_inside_is_a_softmax_over_the_offsets_that_stay_in_the_image() -> None:
    values, logits = made(5, 7, 6, count=1)
    logits[:, 0, 0] = 2000.0  # outside for the first two rows and columns; exp of it overflows
    image, inside = values[:, 0], torch.ones_like(values[:, 0, :1])
    unfolded = F.unfold(inside, 5, padding=2).reshape(2, 25, 7, 6)
    weights = logits[:, 0].masked_fill(unfolded == 0, -torch.inf).softmax(1)
    found = gather_inside(image, logits[:, 0], 5)
    torch.testing.assert_close(found, fold_gather(image, weights, 5))
    constant = gather_inside(torch.full_like(image, 7.0).float(), logits[:, 0].float(), 5)
    torch.testing.assert_close(constant, torch.full_like(constant, 7.0), rtol=1e-6, atol=0)


def test_exponential_weights_are_relative_to_the_largest_of_the_pixel_that_splats() -> None:
    values, logits = made(5)
    logits[0, 1] += 900.0  # exp of it overflows; so would exp of the others with the shift of another pixel
    shift = logits.amax((1, 2), keepdim=True)
    expected = plain_splat(values, (logits - shift).exp(), 5)
    close(splat_exp(values, logits, 5), expected)
    close(splat_exp(values, logits, 5, shift), expected)
    one_by_one = [splat_exp(values[:, n : n + 1], logits[:, n : n + 1], 5, shift) for n in range(3)]
    close((sum(s.total for s in one_by_one), sum(s.weight for s in one_by_one)), expected)  # type: ignore[arg-type]


def test_the_shift_may_belong_to_the_pixel_that_is_reached() -> None:
    values, logits = made(5)
    shift = torch.rand(2, 1, 6, 7, dtype=torch.float64)
    total, weight = plain_splat(values, logits.exp(), 5)
    close(splat_shifted(values, logits, 5, shift), (total / shift.exp(), weight / shift.exp()))


def loss(found: Splatted | tuple[Tensor, Tensor]) -> Tensor:
    total, weight = found
    scale = torch.linspace(0.5, 2.0, total[0].numel(), dtype=total.dtype).reshape(total[0].shape)
    return (scale * total / (weight + 1e-6)).sum() + (weight * scale[:1]).sum()


@pytest.mark.usefixtures("chunk")
@pytest.mark.parametrize("size", [3, 17])
def test_gradients_equal_those_of_products_folded(size: int) -> None:
    values, logits = (t.requires_grad_() for t in made(size, 6, 9))
    given = torch.rand(2, 3, 1, 6, 9, dtype=torch.float64).requires_grad_()

    def own(logits: Tensor) -> Tensor:
        return (logits - logits.amax((1, 2), keepdim=True)).exp()

    weights = logits.detach().exp().requires_grad_()
    pairs = [
        (splat(values, weights, size), fold_splat(values, weights, size), (values, weights)),
        (splat_exp(values, logits, size), fold_splat(values, own(logits), size), (values, logits)),
        (
            splat_exp(values, logits, size, given),
            fold_splat(values, (logits - given).exp(), size),
            (values, logits, given),
        ),
    ]
    for found, expected, inputs in pairs:
        close(torch.autograd.grad(loss(found), inputs), torch.autograd.grad(loss(expected), inputs), 1e-9)


def test_gradients_are_those_of_finite_differences() -> None:
    values, logits = (t.requires_grad_() for t in made(3, 3, 2, 2, 2, 1))
    shift = torch.rand(1, 1, 3, 2, dtype=torch.float64)
    check = torch.autograd.gradcheck
    assert check(lambda v, w: splat(v, w, 3), (values, logits))
    assert check(lambda v, w: splat_exp(v, w, 3), (values, logits))
    assert check(lambda v, w: splat_shifted(v, w, 3, shift), (values, logits))
    assert check(lambda w: splat_exp(values.detach(), w, 3), (logits,))
    assert check(lambda v: splat_exp(v, logits.detach(), 3), (values,))
    image, weights = values[:, 0].detach().requires_grad_(), logits[:, 0].detach().requires_grad_()
    assert check(lambda v, w: gather_weighted(v, w, 3), (image, weights))
    assert check(lambda v, w: gather_inside(v, w, 3), (image, weights))


def test_layers_that_are_kept_apart_share_their_largest_logit_in_values_and_gradients() -> None:
    values, logits = (t.requires_grad_() for t in made(5, 6, 7))
    own = (logits - logits.amax((1, 2), keepdim=True)).exp()
    apart = [fold_splat(values[:, n : n + 1], own[:, n : n + 1], 5)[0] for n in range(values.shape[1])]
    expected, found = torch.stack(apart, 1), splat_apart(values, logits, 5)
    close((found,), (expected,))
    close((splat_apart(values, logits, 5, beyond=True)[..., 2:-2, :],), (expected,))
    close(
        *(torch.autograd.grad(made_.square().sum().sqrt(), (values, logits)) for made_ in (found, expected))
    )


def test_a_gather_equals_the_loop_over_pixels_and_offsets() -> None:
    values, weights = made(3, 4, 5, 1, 1, 2)
    image, kernels = values[:, 0], weights[:, 0]
    expected = torch.zeros_like(image)
    for y in range(4):
        for x in range(5):
            for index in range(9):
                row, column = y + index // 3 - 1, x + index % 3 - 1
                if 0 <= row < 4 and 0 <= column < 5:
                    expected[:, :, y, x] += kernels[:, index, y, x, None] * image[:, :, row, column]
    close((gather_weighted(image, kernels, 3),), (expected,))


def test_an_impulse_is_gathered_by_the_mirrored_kernels_of_its_neighbours() -> None:
    _, weights = made(3, 5, 5, 1, 1, 1)
    image = torch.zeros(1, 1, 5, 5, dtype=torch.float64)
    image[..., 2, 3] = 1.0
    found = gather_weighted(image, weights[:, 0], 3)[0, 0]
    for index in range(9):
        row, column = 2 - (index // 3 - 1), 3 - (index % 3 - 1)
        assert found[row, column] == weights[0, 0, index, row, column]
    assert found.count_nonzero() == 9


def test_equal_logits_have_a_gradient_that_is_a_subgradient_of_the_maximum() -> None:
    values, _ = (t.requires_grad_() for t in made(3))
    logits = torch.zeros(2, 3, 9, 6, 7, dtype=torch.float64).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(splat_exp(values, logits, 3)), logits)
    shared = torch.zeros_like(logits).requires_grad_()
    folded = fold_splat(values, (shared - shared.amax((1, 2), keepdim=True)).exp(), 3)
    (expected,) = torch.autograd.grad(loss(folded), shared)
    close((gradient.sum((1, 2)),), (expected.sum((1, 2)),))


def test_half_precision_logits_are_weighed_in_float32() -> None:
    values, logits = made(5)
    short, single = logits.bfloat16().requires_grad_(), logits.bfloat16().float().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        found = splat_exp(values.bfloat16(), short, 5)
        gathered = gather_inside(values[:, 0].float(), short[:, 0], 5)
    expected = splat_exp(values.bfloat16().float(), single, 5)
    assert found.total.dtype == gathered.dtype == torch.float32
    assert torch.equal(found.total, expected.total)
    loss(found).backward()
    loss(expected).backward()
    assert short.grad is not None
    assert single.grad is not None
    assert short.grad.dtype == torch.bfloat16
    torch.testing.assert_close(short.grad.float(), single.grad, rtol=0.02, atol=1e-3)


def test_kernels_in_another_memory_format_give_the_same() -> None:
    values, logits = made(3, count=1)
    last = logits[:, 0].contiguous(memory_format=torch.channels_last)[:, None].requires_grad_()
    plain = logits.clone().requires_grad_()
    close(splat_exp(values, last, 3), splat_exp(values, plain, 3))
    (found,) = torch.autograd.grad(loss(splat_exp(values, last, 3)), last)
    (expected,) = torch.autograd.grad(loss(splat_exp(values, plain, 3)), plain)
    close((found,), (expected,))


def test_memory_beyond_inputs_and_gradients_is_a_small_part_of_the_kernels() -> None:
    values, logits = (
        torch.rand(1, 3, 3, 96, 96).requires_grad_(),
        torch.randn(1, 3, 289, 96, 96).requires_grad_(),
    )

    def step() -> None:
        values.grad = logits.grad = None
        loss(splat_exp(values, logits, 17)).backward()

    gradients = 4 * (values.numel() + logits.numel())
    assert peak_bytes(step) - gradients < 0.25 * 4 * logits.numel()
    with torch.no_grad():
        assert peak_bytes(lambda: splat_exp(values, logits, 17)) < 0.25 * 4 * logits.numel()


class Traced(nn.Module):
    def forward(self, values: Tensor, logits: Tensor) -> tuple[Tensor, ...]:
        shift = logits.amax((1, 2))[:, None]
        image, own = values[:, 0], logits[:, 0]
        return (
            *splat(values, logits, 5),
            *splat_exp(values, logits, 5),
            *splat(values, logits, 5, beyond=True),
            *splat_exp(values, logits, 5, beyond=True),
            *splat_shifted(values, logits, 5, shift),
            gather_weighted(image, own, 5),
            gather_inside(image, own, 5),
        )


def test_a_traced_splat_runs_at_another_size_and_number_of_samples() -> None:
    with torch.no_grad(), pytest.warns(DeprecationWarning, match="torch.jit.trace"):
        traced = torch.jit.trace(Traced(), tuple(t.float() for t in made(5)), check_trace=False)
    other = tuple(t.float() for t in made(5, 11, 8, count=5, batch=1))
    close(traced(*other), Traced()(*other), 1e-4)


@pytest.mark.parametrize(
    ("size", "shape", "message"),
    [
        (4, (2, 3, 16, 6, 7), "kernel size 4; expected an odd number"),
        (3, (2, 3, 25, 6, 7), "expected .2, 3, 9, 6, 7."),
        (3, (2, 2, 9, 6, 7), "shape .2, 2, 9, 6, 7., expected .2, 3, 9, 6, 7."),
    ],
)
def test_wrong_sizes_are_named(size: int, shape: tuple[int, ...], message: str) -> None:
    values, _ = made(3)
    for call in (splat, splat_exp):
        with pytest.raises(ValueError, match=message):
            call(values, torch.rand(shape), size)
    if size % 2 == 0:
        with pytest.raises(ValueError, match=message):
            gather_inside(values[:, 0], torch.rand(2, 16, 6, 7), size)
