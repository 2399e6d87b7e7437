"""Transformer blocks of AFGSA: attention guided by auxiliary features, then two 3x3 convolutions.

Yu et al. 2021 (doi:10.1145/3478513.3480565), equations 4 and 5, with the authors' code where it differs:
queries and keys are computed from m = ReLU(1x1 convolution of [x; auxiliary features]) and no layer is
normalised.
"""

from __future__ import annotations

from typing import Literal, cast

import torch
from torch import Tensor, nn

from models.blocks.reflect_conv import ReflectConv
from models.ops.block_attention import attention_weights, block_attention
from models.ops.reflect_conv import pointwise
from models.ops.windows import Windows

Guidance = Literal["attention", "concatenate", "none"]


class GuidedAttention(nn.Module):
    """Attention whose queries and keys see auxiliary features.

    Args:
        width: Channels of the features.
        windows: Heads, and which pixels are attended to.
        guidance: `attention`: q and k from [x; aux], v from x alone (equation 4); `concatenate`: all three
            from [x; aux] (figure 3b); `none`: all three from x (equation 3).
    """

    def __init__(self, width: int, windows: Windows, guidance: Guidance) -> None:
        super().__init__()
        self.windows, self.guidance = windows, guidance
        shape = (windows.own[1], width // windows.heads // 2)
        self.rows = nn.Parameter(torch.randn(shape))
        self.columns = nn.Parameter(torch.randn(shape))
        self.fusion = None if guidance == "none" else nn.Conv2d(2 * width, width, 1)
        self.query = nn.Conv2d(width, width, 1, bias=False)
        self.key = nn.Conv2d(width, width, 1, bias=False)
        self.value = nn.Conv2d(width, width, 1, bias=False)
        for projection in (self.query, self.key, self.value):
            nn.init.kaiming_normal_(projection.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor, aux: Tensor | None) -> Tensor:
        """Return the attended values (B, width, H, W) of features x and aux of the same shape."""
        q, k, v = self.project(x, aux)
        return block_attention(q, k, v, (self.rows, self.columns), self.windows)

    def weights(self, x: Tensor, aux: Tensor | None, pixel: tuple[int, int]) -> Tensor:
        """Return the attention (B, heads, H, W) of the pixel at (row, column)."""
        q, k, _ = self.project(x, aux)
        return attention_weights(q, k, (self.rows, self.columns), self.windows, pixel)

    def project(self, x: Tensor, aux: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries, keys and values, each (B, width, H, W)."""
        mixed = x
        if self.fusion is not None and aux is not None:
            mixed = pointwise([x, aux], self.fusion.weight, self.fusion.bias).relu_()
        # One product instead of two: both read the same features.
        both = torch.cat([self.query.weight, self.key.weight])
        q, k = pointwise([mixed], both).chunk(2, 1)
        v = pointwise([x if self.guidance == "attention" else mixed], self.value.weight)
        return q, k, v


class TransformerBlock(nn.Module):
    """x + attention(x, aux), then y + feed_forward(y): equation 5."""

    def __init__(self, width: int, windows: Windows, guidance: Guidance) -> None:
        super().__init__()
        self.attention = GuidedAttention(width, windows, guidance)
        self.first = ReflectConv(width, width, 3)
        self.second = ReflectConv(width, width, 3)

    def forward(self, x: Tensor, aux: Tensor | None) -> Tensor:
        """Return features of the shape of x, (B, width, H, W)."""
        y = x + self.attention(x, aux)
        return cast(Tensor, self.second(self.first(y), residual=y))
