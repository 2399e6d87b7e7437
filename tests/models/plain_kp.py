"""KP written down step by step from its description: the reference that tests and benchmarks compare with.

Nothing of the product's code is used: one convolution for every branch, loops over pixels and offsets.
`unfold_gather` is the same filter as one writes it with PyTorch, where loops would take too long.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor


def plain_gather_inside(image: Tensor, logits: Tensor, size: int) -> Tensor:
    """Visit every pixel, list the neighbours that there are, weigh them by the softmax of their logits."""
    batch, _, height, width = image.shape
    reach, result = size // 2, torch.zeros_like(image)
    for b, y, x in product(range(batch), range(height), range(width)):
        chosen, neighbours = [], []
        for dy, dx in product(range(-reach, reach + 1), range(-reach, reach + 1)):
            if 0 <= y + dy < height and 0 <= x + dx < width:
                chosen.append(logits[b, size * (dy + reach) + dx + reach, y, x])
                neighbours.append(image[b, :, y + dy, x + dx])
        powers = torch.stack([(logit - max(chosen)).exp() for logit in chosen])
        for power, neighbour in zip(powers, neighbours, strict=True):
            result[b, :, y, x] += power / powers.sum() * neighbour
    return result


def unfold_gather(image: Tensor, logits: Tensor, size: int) -> Tensor:
    """Unfold the image, mask the logits of what is outside, softmax, multiply, sum."""
    batch, channels, height, width = image.shape
    inside = F.unfold(torch.ones_like(image[:1, :1]), size, padding=size // 2)
    outside = inside.reshape(1, size * size, height, width) == 0
    weights = logits.masked_fill(outside, -torch.inf).softmax(1)
    patches = F.unfold(image, size, padding=size // 2).reshape(batch, channels, size * size, height, width)
    return (patches * weights[:, None]).sum(2)


def plain_features(buffers: Mapping[str, Tensor]) -> Tensor:
    """Return the ten channels of a frame whose exposure is 1."""
    color = (buffers["irradiance"] * buffers["albedo"]).clamp(min=0) ** 0.454545
    frames = []
    for depth in buffers["depth"]:
        frames.append((depth - depth.min()) / (depth.max() - depth.min()))
    normal = (buffers["normal"] + 1) / 2
    return torch.cat([color.clamp(max=1), buffers["albedo"], normal, torch.stack(frames)], 1)


def plain_logits(state: Mapping[str, Tensor], buffers: Mapping[str, Tensor]) -> Tensor:
    """Run the blocks of a state dict, without biases and normalisation."""
    maps = plain_features(buffers)
    layers = len({name.split(".")[1] for name in state})
    for layer in range(layers):
        five, three, one = (state[f"blocks.{layer}.convolutions.{branch}.weight"] for branch in range(3))
        total = F.conv2d(maps, five, padding=2) + F.conv2d(maps, three, padding=1) + F.conv2d(maps, one)
        if 0 < layer < layers - 1:
            total = total + maps
        maps = total if layer == layers - 1 else torch.where(total > 0, total, 0.1 * total)
    return maps


def plain_kp(state: Mapping[str, Tensor], buffers: Mapping[str, Tensor], size: int) -> Tensor:
    """The whole network, from a state dict."""
    filtered = plain_gather_inside(buffers["irradiance"], plain_logits(state, buffers), size)
    return filtered * buffers["albedo"]
