"""Figure 1: one training step of WSKP on 8 patches of 128x128, against a plain implementation.

Plain: every branch is convolved by itself, windows are summed by dense convolutions with ones, gradients by
ordinary automatic differentiation. A step is forward, SMAPE and backward. Peak memory is that of PyTorch's
allocator (`tests.benchmarks.memory`).

Gradients are compared twice, as the largest difference relative to the largest entry of each tensor: in
float64, which shows that both compute the same, and each in float32 against plain float64, which shows
rounding. The second comparison is made with a linear network and loss: at the kinks of leaky ReLU and of
|o - t| a rounding error of 1e-7 flips a sign now and then, which moves a gradient by 1e-5 to 1e-4 in either
implementation and says nothing about its precision.

    python -m tests.benchmarks.training_step
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from models import WSKP
from models.blocks.rep import RepBlock
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


def double_difference(network: WSKP, buffers: dict[str, Tensor], reference: Tensor) -> float:
    """Return the difference of our gradients and the plain ones in float64."""
    wide = {name: image.double() for name, image in buffers.items()}
    ours, plain = copy.deepcopy(network).double(), copy.deepcopy(network).double()
    step(ours, our_forward, wide, reference.double())
    step(plain, plain_forward, wide, reference.double())
    return gradient_error(ours, plain)


def rounding(network: WSKP, buffers: dict[str, Tensor], weights: Tensor) -> dict[str, float]:
    """Return the float32 gradients' error against plain float64, for a linear network and loss."""
    linear = copy.deepcopy(network)
    for block in linear.blocks:
        cast(RepBlock, block).activation = "none"
    exact = copy.deepcopy(linear).double()
    exact.zero_grad()
    wide = {name: image.double() for name, image in buffers.items()}
    (plain_forward(exact, wide) * weights.double()).mean().backward()
    errors = {}
    for name, forward in (("ours", our_forward), ("plain", plain_forward)):
        linear.zero_grad()
        (forward(linear, buffers) * weights).mean().backward()
        errors[name] = gradient_error(linear, exact)
    return errors


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
    # Warm-ups have run, so that lasting allocations are not counted.
    memory = {name: peak_bytes(call) for name, call in calls.items()}
    same, errors = double_difference(network, buffers, reference), rounding(network, buffers, reference)
    speed, share = times["plain"] / times["ours"], memory["ours"] / memory["plain"]
    return [
        row("training step 8x128x128, plain", times["plain"] * 1e3, "ms"),
        row("training step 8x128x128, ours", times["ours"] * 1e3, "ms"),
        row("training step: plain / ours", speed, "x", ">= 3", speed >= 3),
        row("training step: peak memory, plain", memory["plain"] / 1e6, "MB"),
        row("training step: peak memory, ours", memory["ours"] / 1e6, "MB"),
        row("training step: memory ours / plain", share, "", "<= 0.5", share <= 0.5),
        row("training step: gradients, ours against plain, float64", same, "", "<= 1e-5", same <= 1e-5),
        row(
            "training step: gradients, rounding of ours",
            errors["ours"],
            "",
            "<= 1e-5",
            errors["ours"] <= 1e-5,
        ),
        row("training step: gradients, rounding of plain", errors["plain"], ""),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
