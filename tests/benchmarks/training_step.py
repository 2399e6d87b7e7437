"""Figure 1: one training step of WSKP on 8 patches of 128x128, against a plain implementation.

Plain: every branch is convolved by itself, windows are summed by dense convolutions with ones, gradients by
ordinary automatic differentiation. A step is forward, SMAPE and backward. Peak memory is that of PyTorch's
allocator (`tests.benchmarks.memory`). Gradients are compared with those of the plain implementation in
float64, since in float32 the plain one itself is the less accurate of the two; its error is printed too.

    python -m tests.benchmarks.training_step
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from models import WSKP
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.plain_wskp import plain_forward
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import random_buffers

PATCHES, SIZE = 8, 128
Forward = Callable[[WSKP, dict[str, Tensor]], Tensor]


def our_forward(network: WSKP, buffers: dict[str, Tensor]) -> Tensor:
    """The network as it ships."""
    return network(buffers).color


def step(network: WSKP, forward: Forward, buffers: dict[str, Tensor], reference: Tensor) -> None:
    """Forward, SMAPE and backward."""
    network.zero_grad(set_to_none=True)
    color = forward(network, buffers)
    loss = ((color - reference).abs() / (color.abs() + reference.abs() + 0.01)).mean()
    loss.backward()


def gradient_error(found: WSKP, expected: WSKP) -> float:
    """Return the largest difference of a gradient, relative to the largest entry of its tensor."""
    errors = []
    for one, other in zip(found.parameters(), expected.parameters(), strict=True):
        assert one.grad is not None
        assert other.grad is not None
        errors.append(float((one.grad.double() - other.grad).abs().max() / other.grad.abs().max()))
    return max(errors)


def run() -> list[Row]:
    """Measure and return the rows of figure 1."""
    torch.manual_seed(0)
    buffers, network = random_buffers(PATCHES, SIZE, SIZE), WSKP()
    reference = torch.rand(PATCHES, 3, SIZE, SIZE)
    calls = {
        "ours": lambda: step(network, our_forward, buffers, reference),
        "plain": lambda: step(network, plain_forward, buffers, reference),
    }
    times = medians(calls, {"ours": 9, "plain": 9})
    # One warm-up each has run, so that lasting allocations are not counted.
    memory = {name: peak_bytes(call) for name, call in calls.items()}
    exact = copy.deepcopy(network).double()
    wide = {name: image.double() for name, image in buffers.items()}
    step(exact, plain_forward, wide, reference.double())
    errors = {}
    for name, call in calls.items():
        call()
        errors[name] = gradient_error(network, exact)
    speed, share = times["plain"] / times["ours"], memory["ours"] / memory["plain"]
    return [
        row("training step 8x128x128, plain", times["plain"] * 1e3, "ms"),
        row("training step 8x128x128, ours", times["ours"] * 1e3, "ms"),
        row("training step: plain / ours", speed, "x", ">= 3", speed >= 3),
        row("training step: peak memory, plain", memory["plain"] / 1e6, "MB"),
        row("training step: peak memory, ours", memory["ours"] / 1e6, "MB"),
        row("training step: memory ours / plain", share, "", "<= 0.5", share <= 0.5),
        row("training step: gradient error of ours", errors["ours"], "", "<= 1e-5", errors["ours"] <= 1e-5),
        row("training step: gradient error of plain in float32", errors["plain"], ""),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
