"""The U-Net of multi-resolution kernel prediction: average pooling, unpooled skips, a head per resolution.

Source: the code of Meng et al. 2020 for MR-KP, the variant of Vogels et al. 2018 that Fan et al. 2021
(doi:10.1111/cgf.14338) compare WSKP with.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class AverageUNet(nn.Module):
    """3x3 convolutions with ReLU on halved resolutions, 3x3 transposed ones back; linear heads.

    An encoder stage convolves and takes means of 2x2 pixels for the next one. A decoder stage doubles
    the resolution by a transposed convolution and joins what the encoder stage of that resolution made before
    its pooling. Heads convolve what is joined. There is no convolution between encoder and decoder.

    Args:
        inputs: Channels of the input.
        width: Channels of every stage.
        levels: Encoder stages.
        heads: Channels of the outputs at full, half … resolution, at most `levels`.

    Raises:
        ValueError: There are more heads than levels.
    """

    def __init__(self, inputs: int, width: int, levels: int, heads: Sequence[int]) -> None:
        super().__init__()
        if len(heads) > levels:
            raise ValueError(f"{len(heads)} outputs need as many levels, got {levels}")
        self.encoder = nn.ModuleList(
            nn.Conv2d(before, width, 3, padding=1) for before in (inputs, *[width] * (levels - 1))
        )
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(before, width, 3, stride=2, padding=1, output_padding=1)
            for before in (width, *[2 * width] * (levels - 1))
        )
        self.heads = nn.ModuleList(nn.Conv2d(2 * width, outputs, 3, padding=1) for outputs in heads)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Return what the heads make, from fine to coarse: (B, heads[0], H, W), (B, heads[1], H / 2, W / 2) …

        Args:
            image: (B, inputs, H, W), sides multiples of 2**levels.
        """
        maps, skips = image, []
        for convolution in self.encoder:
            skips.append(F.relu_(convolution(maps)))
            maps = F.avg_pool2d(skips[-1], 2)
        made: list[Tensor] = []
        for convolution in self.decoder:
            maps = torch.cat([F.relu_(convolution(maps)), skips.pop()], 1)
            if len(skips) < len(self.heads):
                made.append(self.heads[len(skips)](maps))
        return made[::-1]

    def halo(self, needed: Sequence[int]) -> int:
        """Return how many pixels around a core on the grid of 2**levels the outputs depend on.

        Args:
            needed: For every output the pixels of its own resolution around the core at which it is needed;
                below and to the right of the core at least.
        """
        reach, joined = 0, []
        for level in range(len(self.encoder)):
            reach = max(reach, needed[level] + 1) if level < len(self.heads) else reach
            joined.append(reach)
            # The last row of a doubled image also depends on the next one of its source.
            reach = reach // 2 + 1
        for level in range(len(self.encoder) - 1, -1, -1):
            reach = max(2 * reach, joined[level]) + 1
        return reach
