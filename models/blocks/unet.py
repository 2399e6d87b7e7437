"""The U-Net of the layer embedding paper: pooled skips, and the input itself as the finest one.

Source: Figure 3 of Munkberg and Hasselgren 2020 (doi:10.1111/cgf.14049), with widths and joints as in the
authors' code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.blocks.pointwise import SLOPE, convolution

Upsampling = Literal["nearest", "bilinear"]


class UNet(nn.Module):
    """3x3 convolutions with leaky ReLU on levels of halved resolution; the last one is linear.

    Every encoder stage ends with a 2x2 maximum. A decoder stage doubles the resolution, joins the *pooled*
    output of the encoder stage of that resolution, the finest one the network's input, and convolves twice.

    Args:
        inputs: Channels of the input.
        finest: Channels of the two convolutions at full resolution.
        encoder: Channels of the other encoder stages, one convolution each; the last repeats as bottleneck.
        decoder: Channels of the decoder stages, from coarse to fine, one more than `encoder`.
        outputs: Channels of the output.
        upsampling: `nearest` as in the authors' code, `bilinear` as in the paper.
    """

    def __init__(
        self,
        inputs: int,
        finest: int,
        encoder: Sequence[int],
        decoder: Sequence[int],
        outputs: int,
        upsampling: Upsampling = "nearest",
    ) -> None:
        super().__init__()
        if upsampling not in ("nearest", "bilinear"):
            raise ValueError(f"upsampling {upsampling!r}; expected nearest or bilinear")
        if len(decoder) != len(encoder) + 1:
            raise ValueError(f"{len(encoder)} encoder widths need {len(encoder) + 1} for the decoder")
        self.upsampling = upsampling
        widths = [finest, *encoder]
        self.levels = len(widths)
        self.entry = convolution(inputs, finest, 3)
        self.encoder = nn.ModuleList(
            convolution(before, after, 3) for before, after in zip([finest, *widths], widths, strict=False)
        )
        self.bottleneck = convolution(widths[-1], widths[-1], 3)
        skips = [*widths[-2::-1], inputs]
        befores = [widths[-1], *decoder]
        self.join = nn.ModuleList(
            convolution(before + skip, after, 3)
            for before, skip, after in zip(befores, skips, decoder, strict=False)
        )
        self.refine = nn.ModuleList(convolution(width, width, 3) for width in decoder)
        self.exit = convolution(decoder[-1], outputs, 3)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Return what every decoder stage makes, from fine to coarse; the finest after the last convolution.

        Args:
            image: (B, inputs, H, W), sides multiples of 2**levels.

        Returns:
            (B, outputs, H, W), then (B, decoder[-2], H / 2, W / 2), (B, decoder[-3], H / 4, W / 4) …
        """
        maps, skips = F.leaky_relu(self.entry(image), SLOPE, inplace=True), [image]
        for layer in self.encoder:
            maps = F.max_pool2d(F.leaky_relu(layer(maps), SLOPE, inplace=True), 2)
            skips.append(maps)
        skips.pop()
        maps = F.leaky_relu(self.bottleneck(maps), SLOPE, inplace=True)
        stages: list[Tensor] = []
        for join, refine in zip(self.join, self.refine, strict=True):
            maps = torch.cat([enlarged(maps, 2, self.upsampling), skips.pop()], 1)
            maps = F.leaky_relu(refine(F.leaky_relu(join(maps), SLOPE, inplace=True)), SLOPE, inplace=True)
            stages.append(maps)
        return [self.exit(stages.pop()), *stages[::-1]]

    def halo(self, needed: Sequence[int]) -> int:
        """Return how many pixels around a core on the grid of 2**levels the output depends on.

        Args:
            needed: Pixels around the core at which the output is needed, for full, half … resolution.
        """
        bilinear = self.upsampling == "bilinear"
        reach, largest = 0, 0
        for level in range(self.levels):
            reach = max(reach, needed[level] if level < len(needed) else 0)
            reach += 3 if level == 0 else 2
            largest = max(largest, self._input(reach, level))
            # A bilinear tap reaches into the next cell where a repeated pixel does not.
            reach = reach // 2 + 1 if bilinear else -(-reach // 2)
        return max(largest, self._input(reach + 1, self.levels))

    @staticmethod
    def _input(reach: int, level: int) -> int:
        """Return the pixels of the input that `reach` pixels of a level's pooled maps depend on."""
        for _ in range(level):
            reach = 2 * reach + 1
        return reach + (level > 0)


def enlarged(maps: Tensor, factor: int, mode: Upsampling) -> Tensor:
    """Return maps of `factor` times the size; bilinear ones have half-pixel centres."""
    if mode == "nearest":
        return F.interpolate(maps, scale_factor=factor, mode="nearest")
    return F.interpolate(maps, scale_factor=factor, mode="bilinear", align_corners=False)
