"""Figure 3, KPCN: the 21x21 gather, a whole training step, and inference, against a plain implementation.

Plain: unfold the image, softmax all logits, multiply, sum (`tests.models.plain_kpcn`), ordinary automatic
differentiation. The gather is that of two 128x128 crops; the step is both branches of a network of width 32,
so that the gather's part shows (with the paper's 100 the convolutions are nearly all of it); inference is the
paper's network, one branch of it, on 160x160. Peak memory is that of PyTorch's allocator.

    python -m tests.benchmarks.kpcn
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest import mock

import torch
from torch import Tensor

from models import KPCN
from models import kpcn as module
from models.denoiser import select
from models.ops.gather import gather
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import split_buffers
from tests.models.plain_kpcn import plain_gather

SIZE = 21
CROPS, SIDE = 2, 128
FRAME = 160


def run() -> list[Row]:
    """Measure and return the rows."""
    torch.manual_seed(0)
    return [*gather_rows(), *step_rows(), *inference_rows()]


def gather_rows(repeats: int = 5) -> list[Row]:
    """The gather alone, forward and backward with respect to the logits."""
    image = torch.rand(CROPS, 3, SIDE, SIDE)
    logits = torch.randn(CROPS, SIZE**2, SIDE, SIDE).requires_grad_()
    weights = torch.rand_like(image)

    def once(filter_: Callable[[Tensor, Tensor, int], Tensor]) -> Tensor:
        logits.grad = None
        (filter_(image, logits, SIZE) * weights).sum().backward()
        assert logits.grad is not None
        return logits.grad

    calls = {"ours": lambda: once(gather), "plain": lambda: once(plain_gather)}
    expected, found = calls["plain"](), calls["ours"]()
    error = float((found - expected).abs().max() / expected.abs().max())
    return compared("KPCN gather 21x21, 2x128x128", calls, error, repeats, 0.5)


def step_rows(repeats: int = 5) -> list[Row]:
    """One training step of both branches."""
    network, batch = KPCN(width=32), split_buffers(CROPS, 64, 64)

    def once() -> Tensor:
        network.zero_grad()
        pairs = network.training_pairs(batch)
        torch.stack([(p.output - p.target).abs().mean() for p in pairs.values()]).sum().backward()
        first = next(network.parameters()).grad
        assert first is not None
        return first

    def plain() -> Tensor:
        with plain_filters():
            return once()

    expected, found = plain(), once()
    error = float((found - expected).abs().max() / expected.abs().max())
    return compared("KPCN step, width 32, 2x64x64", {"ours": once, "plain": plain}, error, repeats, None)


def inference_rows(repeats: int = 3) -> list[Row]:
    """One branch of the paper's network on a small frame."""
    network = KPCN(branches="single").eval()
    buffers = select(network, split_buffers(1, FRAME, FRAME))

    @torch.no_grad()
    def ours() -> Tensor:
        color: Tensor = network(buffers).color
        return color

    def plain() -> Tensor:
        with plain_filters(), torch.no_grad(), whole_image():
            return ours()

    expected, found = plain(), ours()
    error = float((found - expected).abs().max() / expected.abs().max())
    name = f"KPCN inference, one branch, {FRAME}x{FRAME}"
    return compared(name, {"ours": ours, "plain": plain}, error, repeats, None)


@contextmanager
def plain_filters() -> Iterator[None]:
    """Let the network filter with `unfold`."""

    def padded(image: Tensor, logits: Tensor, size: int) -> Tensor:
        inner = image.shape[-2] - size + 1, image.shape[-1] - size + 1
        patches = torch.nn.functional.unfold(image, size).reshape(len(image), 3, size * size, *inner)
        return (patches * logits.softmax(1)[:, None]).sum(2)

    with mock.patch.object(module, "gather_padded", padded):
        yield


@contextmanager
def whole_image() -> Iterator[None]:
    """Let the network predict all kernels of an image at once."""
    with mock.patch.object(module, "strips", lambda height, pixels, like: [slice(0, height)]):
        yield


def compared(
    name: str, calls: dict[str, Callable[[], Tensor]], error: float, repeats: int, target: float | None
) -> list[Row]:
    """Return times, memory, their ratios and the difference of two contestants."""
    times = medians(calls, dict.fromkeys(calls, repeats))
    memory = {key: peak_bytes(call) for key, call in calls.items()}
    speed, share = times["plain"] / times["ours"], memory["ours"] / memory["plain"]
    limit = "" if target is None else f"<= {target}"
    return [
        *(row(f"{name}: {key}", times[key] * 1e3, "ms") for key in calls),
        row(f"{name}: plain / ours", speed, "x", ">= 1", speed >= 1),
        *(row(f"{name}: memory, {key}", memory[key] / 1e6, "MB") for key in calls),
        row(f"{name}: memory ours / plain", share, "", limit, None if target is None else share <= target),
        row(f"{name}: largest difference", error, "", "<= 1e-4", error <= 1e-4),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
