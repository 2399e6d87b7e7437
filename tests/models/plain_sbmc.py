"""SBMC written down literally in float64: all samples and all kernels at once, kernels turned into gathers.

Reads the parameters of `models.SBMC` by name and shares nothing else with it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

Parameters = Mapping[str, Tensor]


def plain_sbmc(
    parameters: Parameters, features: Tensor, radiance: Tensor, size: int, levels: int, gather: bool = False
) -> Tensor:
    """Return the image (H, W, 3) of one frame, zeros outside taking weight.

    Args:
        parameters: State of the module, float64.
        features: What the first embedding reads, with the camera's numbers at the end, (S, C, H, W).
        radiance: (S, 3, H, W).
        size: Rows and columns of the kernels.
        levels: Resolutions of the U-Nets.
        gather: Use the kernels as they are.
    """
    rounds = len({name.split(".")[1] for name in parameters if name.startswith("unets.")})
    maps = features
    context = features[:0]
    for step in range(rounds):
        if step:
            maps = torch.cat([maps, context.expand(len(maps), -1, -1, -1)], 1)
        maps = chain(parameters, f"embeddings.{step}", maps, 0.0)
        context = unet(parameters, f"unets.{step}", maps.mean(0, keepdim=True), levels)
    maps = torch.cat([maps, context.expand(len(maps), -1, -1, -1)], 1)
    logits = chain(parameters, "regressor", maps, 0.01)
    return filtered(logits, radiance, size, gather)


def filtered(logits: Tensor, radiance: Tensor, size: int, gather: bool) -> Tensor:
    """Return the softmax mean over samples and offsets, by a running maximum over samples."""
    count, _, height, width = radiance.shape
    reach = size // 2
    total, weight = torch.zeros(height, width, 3), torch.zeros(height, width)
    total, weight = total.double(), weight.double()
    maximum = torch.full((height, width), -torch.inf).double()
    for sample in range(count):
        padded = F.pad(radiance[sample], [reach] * 4)
        moved = F.pad(logits[sample], [reach] * 4)
        taken, seen = [], []
        for dy in range(size):
            for dx in range(size):
                part = padded[:, dy : dy + height, dx : dx + width]
                own = logits[sample, dy * size + dx]
                if not gather:  # the neighbour at (dy, dx) sends here with its opposite offset
                    opposite = (size - 1 - dy) * size + (size - 1 - dx)
                    own = moved[opposite, dy : dy + height, dx : dx + width]
                taken.append(own)
                seen.append(part)
        kernel, values = torch.stack(taken), torch.stack(seen)
        larger = torch.maximum(maximum, kernel.amax(0))
        scale = (maximum - larger).exp()
        weights = (kernel - larger).exp()
        total = total * scale[..., None] + (weights[:, None] * values).sum(0).permute(1, 2, 0)
        weight = weight * scale + weights.sum(0)
        maximum = larger
    return total / (weight + 1e-8)[..., None]


def chain(parameters: Parameters, prefix: str, maps: Tensor, slope: float) -> Tensor:
    """Three 1x1 convolutions, the last one linear."""
    for layer in range(3):
        maps = convolved(parameters, f"{prefix}.layers.{layer}", maps)
        if layer < 2:
            maps = torch.where(maps > 0, maps, slope * maps)
    return maps


def unet(parameters: Parameters, prefix: str, image: Tensor, levels: int) -> Tensor:
    """Down by maxima, up by bilinear interpolation."""

    def side(name: str, maps: Tensor, last: float) -> Tensor:
        for layer in range(3):
            maps = convolved(parameters, f"{prefix}.{name}.{2 * layer}", maps)
            maps = torch.where(maps > 0, maps, (last if layer == 2 else 0.0) * maps)
        return maps

    def level(number: int, maps: Tensor) -> Tensor:
        maps = side(f"down.{number}", maps, 0.0)
        if number == levels - 1:
            return maps
        below = level(number + 1, F.max_pool2d(maps, 2))
        below = F.interpolate(below, maps.shape[-2:], mode="bilinear", align_corners=False)
        return side(f"up.{number}", torch.cat([below, maps], 1), 0.01 if number == 0 else 0.0)

    return level(0, image)


def convolved(parameters: Parameters, name: str, maps: Tensor) -> Tensor:
    """A weight-normalised convolution."""
    direction, gain = parameters[f"{name}.weight"], parameters[f"{name}.gain"]
    norms = torch.stack([filter_.norm() for filter_ in direction])
    weight = direction * (gain.flatten() / norms)[:, None, None, None]
    return F.conv2d(maps, weight, parameters[f"{name}.bias"], padding=weight.shape[-1] // 2)
