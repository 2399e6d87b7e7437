"""What tests of several networks do with one: train it for a moment, run it under autocast."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from models.denoiser import Denoiser


def losses_of(network: Denoiser, loss: Callable[[], Tensor], steps: int, clip: float | None) -> list[float]:
    """Train with Adam and return the loss of each step.

    Args:
        network: The network.
        loss: Returns its loss.
        steps: How many.
        clip: Norm at which gradients are clipped, None: they are not.
    """
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    losses = []
    for _ in range(steps):
        optimizer.zero_grad()
        value = loss()
        value.backward()
        if clip is not None:
            torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
        optimizer.step()
        losses.append(value.item())
    return losses


def assert_bfloat16_stays_near_float32(network: Denoiser, buffers: dict[str, Tensor]) -> None:
    """Check that autocast to bfloat16 moves the mean by less than 2 %, and returns float32."""
    with torch.no_grad():
        expected = network(buffers).color
        with torch.autocast("cpu", torch.bfloat16):
            found = network(buffers).color
    assert found.dtype == torch.float32
    assert (found - expected).abs().mean() < 0.02 * expected.abs().mean()
