"""Small random buffers that look like a frame: for tests of denoisers."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from data.histograms import sample_histogram


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


def noisy_edges(batch: int, height: int, width: int, seed: int = 0) -> tuple[dict[str, Tensor], Tensor]:
    """Return buffers of dark and bright blocks of 8 pixels with noisy light, and the reference.

    Normals tell the blocks apart, so that a network can learn not to blur across their edges.
    """
    buffers = random_buffers(batch, height, width, seed)
    rows, columns = torch.arange(height) // 8, torch.arange(width) // 8
    bright = ((rows[:, None] + columns) % 2).float()
    light = 0.1 + 0.9 * bright.expand(batch, 3, -1, -1)
    normal = torch.zeros_like(buffers["normal"])
    normal[:, 0], normal[:, 2] = bright, 1 - bright
    noise = buffers["irradiance"] / 2  # of mean 1
    noisy = {
        **buffers,
        "normal": normal,
        "irradiance": light * noise,
        "depth": torch.ones(batch, 1, height, width),
    }
    return noisy, light * buffers["albedo"]


def split_buffers(batch: int, height: int, width: int, seed: int = 0) -> dict[str, Tensor]:
    """Return those and color, its diffuse and specular parts, references, halves, variances, a histogram."""
    buffers = lit(random_buffers(batch, height, width, seed))
    generator = torch.Generator().manual_seed(seed + 1000)
    for name in ("color", "diffuse", "specular", "albedo", "normal", "depth"):
        spread = torch.rand(buffers[name].shape, generator=generator) ** 4
        buffers[f"{name}_variance"] = 0.05 * spread * buffers[name].square()
    for name in ("albedo", "normal", "depth"):
        shift = 0.05 * torch.rand(buffers[name].shape, generator=generator) * buffers[name]
        buffers[f"{name}_a"], buffers[f"{name}_b"] = buffers[name] + shift, buffers[name] - shift
    for name, source in (("reference", "color"), ("reference_diffuse", "diffuse")):
        buffers[name] = torch.nn.functional.avg_pool2d(buffers[source], 5, 1, 2)
    light = -torch.log1p(-torch.rand(batch, 8, 3, height, width, generator=generator))
    buffers["histogram"] = histogram_of(buffers["color"][:, None] * light)
    return buffers


def histogram_of(samples: Tensor) -> Tensor:
    """Histograms (B, 60, H, W) of samples (B, S, 3, H, W)."""
    images = [sample_histogram(image.permute(0, 2, 3, 1).numpy()) for image in samples.detach()]
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).to(samples.dtype)


def lit(buffers: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the buffers with color, its halves, diffuse and specular as irradiance and albedo make them."""
    color = buffers["irradiance"] * buffers["albedo"]
    shift = 0.3 * color * torch.linspace(-1, 1, color.numel()).reshape(color.shape).mul(1e4).sin()
    halves = {"color_a": color + shift, "color_b": color - shift}
    return {**buffers, "color": color, "diffuse": 0.75 * color, "specular": 0.25 * color, **halves}


def random_samples(batch: int, spp: int, height: int, width: int, seed: int = 0) -> Tensor:
    """Return samples (B, S, 20, H, W) of a random surface, as the networks of `models.layers` read them."""
    generator = torch.Generator().manual_seed(seed)

    def noise(channels: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        unit = torch.rand(batch, spp, channels, height, width, generator=generator)
        return low + (high - low) * unit

    radiance = -2.0 * torch.log1p(-noise(3)) * noise(3)
    normal = torch.nn.functional.normalize(noise(3) - 0.5, dim=2)
    blur = [noise(2, -8, 8), noise(1, -3, 6), noise(2, -1, 1), noise(1)]
    return torch.cat([radiance, normal, noise(1, 2, 5), noise(3), noise(3), noise(1), *blur], 2)


def sampled(buffers: dict[str, Tensor], spp: int = 3) -> dict[str, Tensor]:
    """Return the buffers with samples (B, S, 20, H, W) that have their radiance, normal, depth, albedo."""
    color = buffers["color"]
    made = random_samples(len(color), spp, *color.shape[2:])
    guides = torch.cat([buffers[name] for name in ("color", "normal", "depth", "albedo")], 1)
    made[:, :, :10] = guides[:, None]
    return {**buffers, "samples": made}


def luminous(buffers: dict[str, Tensor], value: float) -> dict[str, Tensor]:
    """Return the buffers with constant irradiance."""
    return {**buffers, "irradiance": torch.full_like(buffers["irradiance"], value)}


def largest_relative(found: Tensor, expected: Tensor) -> float:
    """Return the largest difference relative to the largest expected value."""
    scale = expected.abs().max().item()
    difference = (found.double() - expected.double()).abs().max().item()
    return difference / scale if scale > 0 else math.inf * difference if difference else 0.0
