"""A convolution with reflected borders and its activation as one layer."""

from __future__ import annotations

from typing import cast

from torch import Tensor, nn

from models.ops.reflect_conv import reflect_conv


class ReflectConv(nn.Conv2d):
    """Convolution of odd size with reflected borders, then a leaky ReLU; keeps the size.

    Args:
        inputs: Channels in.
        outputs: Channels out.
        size: Odd kernel size.
        slope: Of negative values; 0 is a ReLU.
    """

    def __init__(self, inputs: int, outputs: int, size: int, slope: float = 0.0) -> None:
        super().__init__(inputs, outputs, size)
        self.radius, self.slope = size // 2, slope

    def forward(self, images: Tensor, residual: Tensor | None = None) -> Tensor:
        """Return (B, outputs, H, W) of images (B, inputs, H, W), plus `residual` of the result's shape."""
        bias = cast(Tensor, self.bias)
        return reflect_conv(images, self.weight, bias, self.radius, self.slope, residual)
