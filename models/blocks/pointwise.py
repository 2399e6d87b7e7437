"""Fully connected networks that run at every pixel: chains of 1x1 convolutions."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.ops.boxes import exporting

SLOPE = 0.01
"""Negative slope of the leaky ReLU of Munkberg and Hasselgren 2020."""


class Pointwise(nn.Module):
    """1x1 convolutions with leaky ReLU (slope 0.01) between; Xavier uniform weights, zero biases.

    Args:
        widths: Channels of the input, between convolutions, and of the output.
        linear: The last convolution has no activation.
    """

    def __init__(self, *widths: int, linear: bool) -> None:
        super().__init__()
        self.linear = linear
        self.first = convolution(widths[0], widths[1], 1)
        self.others = nn.ModuleList(
            convolution(widths[i], widths[i + 1], 1) for i in range(1, len(widths) - 1)
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Return (N, widths[-1], H, W) of (N, widths[0], H, W)."""
        return self._rest(mixed(maps, self.first.weight, self.first.bias))

    def joint(self, own: Tensor, shared: Tensor) -> Tensor:
        """Return what comes of [own, shared] without joining them; see `mixed_jointly`.

        Args:
            own: (B, N, C1, H, W), of N samples or layers.
            shared: (B, C2, H, W).

        Returns:
            (B, N, widths[-1], H, W).
        """
        maps = self._rest(mixed_jointly(own, shared, self.first.weight, self.first.bias))
        return maps.reshape(own.shape[0], -1, *maps.shape[1:])

    def _rest(self, maps: Tensor) -> Tensor:
        for layer in self.others:
            assert isinstance(layer, nn.Conv2d)
            maps = mixed(F.leaky_relu(maps, SLOPE, inplace=True), layer.weight, layer.bias)
        return maps if self.linear else F.leaky_relu(maps, SLOPE, inplace=True)


def mixed(maps: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return the 1x1 convolution of maps (N, C, H, W) with weights (C', C, 1, 1), (N, C', H, W).

    In inference on a CPU it is a product of matrices, which for 2 to 32 channels is up to eight times as
    fast. In training it is not faster.
    """
    if exporting() or torch.is_grad_enabled() or maps.device.type != "cpu":
        return F.conv2d(maps, weight, bias)
    made = torch.matmul(weight[:, :, 0, 0], maps.flatten(2))
    if bias is not None:
        made.add_(bias[:, None])
    return made.unflatten(2, maps.shape[2:])


def mixed_jointly(own: Tensor, shared: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Return the 1x1 convolution of [own, shared] without joining them.

    It is linear in both: what it makes of `shared` is computed once for all N.

    Args:
        own: (B, N, C1, H, W), of N samples or layers.
        shared: (B, C2, H, W) or (B, C2, 1, 1).
        weight: (C', C1 + C2, 1, 1).
        bias: (C',).

    Returns:
        (B * N, C', H, W).
    """
    batch, _, split = own.shape[:3]
    common = mixed(shared, weight[:, split:], bias)
    maps = mixed(own.flatten(0, 1), weight[:, :split])
    return (maps.reshape(batch, -1, *maps.shape[1:]) + common[:, None]).flatten(0, 1)


def convolution(before: int, after: int, size: int) -> nn.Conv2d:
    """Return a convolution padded with zeros to the same size; Xavier uniform weights, zero bias."""
    made = nn.Conv2d(before, after, size, padding=size // 2)
    nn.init.xavier_uniform_(made.weight)
    assert made.bias is not None
    nn.init.zeros_(made.bias)
    return made
