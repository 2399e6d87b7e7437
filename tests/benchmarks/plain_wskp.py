"""WSKP as one would write it down: the implementation that benchmarks compare with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models import WSKP
from models.blocks.rep import RepBlock
from models.denoiser import Buffers


def dense_reconstruct(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Sum every window with a k x k convolution of ones, colour channels one by one, exp without a shift."""
    batch, _, height, width = irradiance.shape
    importance, fusion = log_importance.exp(), fusion_logits.softmax(1)
    total = torch.zeros_like(irradiance)
    for index, size in enumerate(kernel_sizes):
        ones = torch.ones(1, 1, size, size, dtype=irradiance.dtype)
        one = importance[:, index : index + 1]
        below = F.conv2d(one, ones, padding=size // 2)
        weighted = (one * irradiance).reshape(batch * 3, 1, height, width)
        above = F.conv2d(weighted, ones, padding=size // 2).reshape(batch, 3, height, width)
        total = total + fusion[:, index : index + 1] * (above / below)
    return total


def plain_forward(network: WSKP, buffers: Buffers) -> Tensor:
    """Run the network branch by branch, with ordinary automatic differentiation."""
    maps = network._features(buffers)
    for module in network.blocks:
        block = cast(RepBlock, module)
        branches = [
            F.conv2d(maps, c.weight, padding=c.padding) for c in cast(Sequence[nn.Conv2d], block.convolutions)
        ]
        summed = sum(branches[1:], start=branches[0])
        summed = summed + maps if block.identity else summed
        maps = F.leaky_relu(summed, 0.1) if block.activation == "leaky_relu" else summed
    kernels = len(network.kernel_sizes)
    filtered = dense_reconstruct(
        buffers["irradiance"], maps[:, :kernels], maps[:, kernels:], network.kernel_sizes
    )
    return filtered * buffers["albedo"]
