"""Small random buffers that look like a frame: for tests of denoisers."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def random_buffers(batch: int, height: int, width: int, seed: int = 0) -> dict[str, Tensor]:
    """Return irradiance, albedo, normal and depth of a random surface with noisy light."""
    generator = torch.Generator().manual_seed(seed)

    def noise(channels: int) -> Tensor:
        return torch.rand(batch, channels, height, width, generator=generator)

    return {
        "irradiance": -2.0 * torch.log1p(-noise(3)),
        "albedo": 0.05 + 0.9 * noise(3),
        "normal": torch.nn.functional.normalize(noise(3) - 0.5, dim=1),
        "depth": 2.0 + 3.0 * noise(1),
    }


def luminous(buffers: dict[str, Tensor], value: float) -> dict[str, Tensor]:
    """Return the buffers with constant irradiance."""
    return {**buffers, "irradiance": torch.full_like(buffers["irradiance"], value)}


def largest_relative(found: Tensor, expected: Tensor) -> float:
    """Return the largest difference relative to the largest expected value."""
    scale = expected.abs().max().item()
    difference = (found.double() - expected.double()).abs().max().item()
    return difference / scale if scale > 0 else math.inf * difference if difference else 0.0
