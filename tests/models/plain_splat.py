"""Splats and gathers written down literally: loops over samples, pixels and offsets, in float64."""

from __future__ import annotations

from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor


def plain_splat(values: Tensor, weights: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Add every weighted value where it goes; differentiable by automatic differentiation."""
    batch, count, channels, height, width = values.shape
    reach = size // 2
    total = values.new_zeros(batch, channels, height, width)
    weight = values.new_zeros(batch, 1, height, width)
    for n, y, x in product(range(count), range(height), range(width)):
        for index in range(size * size):
            row, column = y + index // size - reach, x + index % size - reach
            if 0 <= row < height and 0 <= column < width:
                one = weights[:, n, index, y, x]
                total[:, :, row, column] += one[:, None] * values[:, n, :, y, x]
                weight[:, 0, row, column] += one
    return total, weight


def plain_splat_softmax(values: Tensor, logits: Tensor, size: int, weigh: bool) -> Tensor:
    """Collect every contribution of every pixel in a list and take its softmax."""
    batch, count, channels, height, width = values.shape
    reach, out = size // 2, values.new_zeros(batch, channels, height, width)
    for b, y, x in product(range(batch), range(height), range(width)):
        arrived, sent = [], []
        for n, dy, dx in product(range(count), range(-reach, reach + 1), range(-reach, reach + 1)):
            row, column = y - dy, x - dx
            if 0 <= row < height and 0 <= column < width:
                arrived.append(logits[b, n, size * (dy + reach) + dx + reach, row, column])
                sent.append(values[b, n, :, row, column])
            elif weigh:
                arrived.append(logits.new_zeros(()))
                sent.append(values.new_zeros(channels))
        weights = torch.stack(arrived)
        weights = (weights - weights.max()).exp()
        out[b, :, y, x] = (weights[:, None] * torch.stack(sent)).sum(0) / (weights.sum() + 1e-8)
    return out


def plain_gather_samples(values: Tensor, logits: Tensor, size: int) -> Tensor:
    """Let every pixel choose among the samples of its neighbours; zeros outside take weight."""
    batch, count, channels, height, width = values.shape
    patches = F.unfold(values.flatten(0, 1), size, padding=size // 2)
    patches = patches.reshape(batch, count, channels, size * size, height, width)
    weights = logits.flatten(1, 2).softmax(1).reshape(logits.shape)
    return (patches * weights[:, :, None]).sum((1, 3))


def fold_splat(values: Tensor, weights: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Splat by forming all products and folding them: fast to write, large in memory."""
    batch, count, channels, height, width = values.shape
    products = (weights[:, :, None] * values[:, :, :, None]).reshape(batch * count, -1, height * width)
    total = F.fold(products, (height, width), size, padding=size // 2)
    weight = F.fold(
        weights.reshape(batch * count, -1, height * width), (height, width), size, padding=size // 2
    )
    return total.reshape(batch, count, channels, height, width).sum(1), weight.reshape(
        batch, count, 1, height, width
    ).sum(1)


def fold_gather(image: Tensor, weights: Tensor, size: int) -> Tensor:
    """Weighted sums by unfolding a zero-padded image."""
    batch, channels, height, width = image.shape
    patches = F.unfold(image, size, padding=size // 2).reshape(batch, channels, size * size, height, width)
    return (patches * weights[:, None]).sum(2)
