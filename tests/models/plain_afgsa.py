"""AFGSA's generator written down literally: the yardstick for `models.AFGSA`, in tests and in benchmarks.

Unfolded keys and values, einsum, softmax, concatenations; nothing is saved or fused. Modules carry the names
of the authors' checkpoints (Yu et al. 2021), so `state_dict()` is what `load_published("afgsa", …)` takes.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class PlainAFGSA(nn.Module):
    """The generator in log space, with the defaults of the authors' scripts: 9,282,691 parameters."""

    def __init__(
        self,
        width: int = 256,
        blocks: int = 5,
        heads: int = 4,
        block: int = 8,
        halo: int = 3,
        mask_halo: bool = False,
    ) -> None:
        super().__init__()
        self.conv1 = convolution(3, width, 1, nn.ReLU())
        self.conv3 = convolution(3, width, 3, nn.ReLU())
        self.conv5 = convolution(3, width, 5, nn.ReLU())
        self.conv_map = convolution(3 * width, width, 1, nn.ReLU())
        self.conv_a1 = convolution(7, width, 1, nn.ReLU())
        self.conv_a3 = convolution(7, width, 3, nn.LeakyReLU(0.2))
        self.conv_a5 = convolution(7, width, 5, nn.LeakyReLU(0.2))
        self.conv_aenc1 = convolution(3 * width, width, 1, nn.LeakyReLU(0.2))
        self.conv_aenc2 = convolution(width, width, 1, nn.LeakyReLU(0.2))
        self.transformer_blocks = nn.ModuleList(
            PlainTransformerBlock(width, PlainAttention(width, heads, block, halo, mask_halo))
            for _ in range(blocks)
        )
        self.decoder = nn.Sequential(
            convolution(width, width, 3, nn.ReLU()),
            convolution(width, width, 3, nn.ReLU()),
            nn.Sequential(nn.Conv2d(width, 3, 3, padding=1)),
        )

    def forward(self, color_log: Tensor, aux: Tensor) -> Tensor:
        """Return the log radiance (B, 3, H, W) of log(1 + color) (B, 3, H, W) and normal, depth, albedo as
        the network sees them (B, 7, H, W); sizes are multiples of the block."""
        x = self.conv_map(torch.cat([self.conv1(color_log), self.conv3(color_log), self.conv5(color_log)], 1))
        a = self.conv_aenc1(torch.cat([self.conv_a1(aux), self.conv_a3(aux), self.conv_a5(aux)], 1))
        a = self.conv_aenc2(a)
        for block in self.transformer_blocks:
            x = block(x, a)
        return self.decoder(x) + color_log


class PlainTransformerBlock(nn.Module):
    """x + attention(x, aux), then x + two convolutions of it."""

    def __init__(self, width: int, attention: PlainAttention) -> None:
        super().__init__()
        self.attention = attention
        self.feed_forward = nn.Sequential(
            convolution(width, width, 3, nn.ReLU()), convolution(width, width, 3, nn.ReLU())
        )

    def forward(self, x: Tensor, aux: Tensor) -> Tensor:
        x = x + self.attention(x, aux)
        return x + self.feed_forward(x)


class PlainAttention(nn.Module):
    """Block attention with the keys and values of all blocks unfolded."""

    def __init__(self, width: int, heads: int, block: int, halo: int, mask_halo: bool) -> None:
        super().__init__()
        self.heads, self.block, self.halo, self.mask_halo = heads, block, halo, mask_halo
        self.window = block + 2 * halo
        half = width // heads // 2
        self.rel_h = nn.Parameter(torch.randn(1, self.window, 1, half))
        self.rel_w = nn.Parameter(torch.randn(1, 1, self.window, half))
        self.conv_map = convolution(2 * width, width, 1, nn.ReLU())
        self.q_conv = nn.Conv2d(width, width, 1, bias=False)
        self.k_conv = nn.Conv2d(width, width, 1, bias=False)
        self.v_conv = nn.Conv2d(width, width, 1, bias=False)
        for projection in (self.q_conv, self.k_conv, self.v_conv):
            nn.init.kaiming_normal_(projection.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor, aux: Tensor) -> Tensor:
        v = self.unfolded(self.v_conv(x), self.halo)
        attended = torch.einsum("bnhqk,bnhdk->bnhdq", self.weights(x, aux), v)
        batch, _, height, width = x.shape
        columns = attended.reshape(batch, -1, x.shape[1] * self.block**2).transpose(1, 2)
        return F.fold(columns, (height, width), self.block, stride=self.block)

    def weights(self, x: Tensor, aux: Tensor) -> Tensor:
        """Return the attention (B, blocks, heads, block², window²)."""
        m = self.conv_map(torch.cat([x, aux], 1))
        q = self.unfolded(self.q_conv(m), 0)
        k = self.unfolded(self.k_conv(m), self.halo)
        head = q.shape[3]
        w = self.window
        rows = self.rel_h.expand(1, w, w, -1)
        columns = self.rel_w.expand(1, w, w, -1)
        k = k + torch.cat([rows, columns], -1).reshape(w * w, head).t()
        scores = torch.einsum("bnhdq,bnhdk->bnhqk", q * head**-0.5, k)
        if self.mask_halo:
            ones = torch.ones_like(x[:, :1]).expand(-1, self.heads, -1, -1)
            inside = self.unfolded(ones, self.halo)
            scores = scores.masked_fill(inside.squeeze(3)[:, :, :, None] == 0, -torch.inf)
        return scores.softmax(-1)

    def unfolded(self, maps: Tensor, halo: int) -> Tensor:
        """Return (B, blocks, heads, channels of a head, pixels of a window)."""
        batch, channels, _, _ = maps.shape
        size = self.block + 2 * halo
        columns = F.unfold(maps, size, padding=halo, stride=self.block)
        shape = (batch, self.heads, channels // self.heads, size * size, -1)
        return columns.reshape(shape).permute(0, 4, 1, 2, 3)


def convolution(inputs: int, outputs: int, size: int, activation: nn.Module) -> nn.Sequential:
    """A convolution with reflected borders and its activation, numbered as in the checkpoints."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, padding=size // 2, padding_mode="reflect"), activation
    )
