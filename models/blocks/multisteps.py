"""The two networks of SBMC (Gharbi et al. 2019, doi:10.1145/3306346.3322954); all weights are normalised."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.blocks.pointwise import mixed, mixed_jointly
from models.ops.precision import wide

SLOPE = 0.01
"""Negative slope of the leaky ReLU of kernel regressors, and of the last layer of a context."""


class Chain(nn.Module):
    """Fully connected layers at every pixel of every sample; the last one is linear.

    Args:
        widths: Channels of the input, between layers, and of the output.
        slope: Negative slope of the activations between.
    """

    def __init__(self, *widths: int, slope: float) -> None:
        super().__init__()
        self.slope = slope
        last = len(widths) - 2
        self.layers = nn.ModuleList(
            NormalisedConv(widths[i], widths[i + 1], 1, None if i == last else slope) for i in range(last + 1)
        )

    def forward(self, own: Tensor, shared: Tensor | None) -> Tensor:
        """Return the output for the input [own, shared], which are not joined; see `mixed_jointly`.

        Args:
            own: (B, N, C1, H, W), of N samples.
            shared: (B, C2, H, W) or (B, C2, 1, 1), or None.

        Returns:
            (B, N, widths[-1], H, W).
        """
        first, *rest = self.layers
        assert isinstance(first, NormalisedConv)
        if shared is None:
            maps = mixed(own.flatten(0, 1), first.kernel(), first.bias)
        else:
            maps = mixed_jointly(own, shared, first.kernel(), first.bias)
        for layer in rest:
            assert isinstance(layer, NormalisedConv)
            maps = mixed(F.leaky_relu(maps, self.slope), layer.kernel(), layer.bias)
        return maps.reshape(own.shape[0], -1, *maps.shape[1:])


class Context(nn.Module):
    """U-Net: three 3x3 convolutions with ReLU per level and side; leaky ReLU at the very end.

    Widths double on every level. Levels are halved by the maximum of 2x2 and enlarged bilinearly, with
    half-pixel centres; a side on the way up reads [enlarged, skip]. The coarsest level has one side.

    Args:
        width: Channels at full resolution, of input and output too.
        levels: Resolutions.
    """

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        widths = [width << level for level in range(levels)]
        self.down = nn.ModuleList(
            _side(before, after) for before, after in zip([width, *widths], widths, strict=False)
        )
        self.up = nn.ModuleList(
            _side(2 * own + own, own, SLOPE if level == 0 else 0.0) for level, own in enumerate(widths[:-1])
        )
        if levels == 1:
            self.down[0] = _side(width, width, SLOPE)

    def forward(self, image: Tensor) -> Tensor:
        """Return (B, width, H, W) of the same; sides multiples of 2**(levels - 1)."""
        maps, skips = image, []
        for level, side in enumerate(self.down):
            maps = side(F.max_pool2d(maps, 2) if level else maps)
            skips.append(maps)
        skips.pop()
        for side in reversed(self.up):
            enlarged = F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
            maps = side(torch.cat([enlarged, skips.pop()], 1))
        return maps

    @staticmethod
    def reach(pixels: int, levels: int) -> int:
        """Return how far around a core on the grid the input counts for what is `pixels` around it."""
        if levels == 1:
            return pixels + 3
        after = pixels + 3
        # A bilinear tap reaches into the next cell; a maximum covers two pixels.
        return max(2 * Context.reach(after // 2 + 1, levels - 1), after) + 3


class NormalisedConv(nn.Conv2d):
    """A convolution whose weights are gain * weight / |weight|, the norm being that of each output channel.

    Starts as an ordinary one, Xavier uniform for the activation that follows, with zero bias.

    Args:
        before: Channels of the input.
        after: Channels of the output.
        size: Rows and columns, odd; zeros keep the size.
        slope: Negative slope of the activation, None: linear.
    """

    gain: nn.Parameter | None

    def __init__(self, before: int, after: int, size: int, slope: float | None) -> None:
        super().__init__(before, after, size, padding=size // 2)
        gain = 1.0 if slope is None else nn.init.calculate_gain("leaky_relu", slope)
        nn.init.xavier_uniform_(self.weight, gain)
        assert self.bias is not None
        nn.init.zeros_(self.bias)
        self.gain = nn.Parameter(self._norm().detach())

    def forward(self, maps: Tensor) -> Tensor:
        """Return (N, after, H, W) of (N, before, H, W)."""
        return F.conv2d(maps, self.kernel(), self.bias, padding=self.padding)

    def kernel(self) -> Tensor:
        """Return the normalised weights."""
        return self.weight if self.gain is None else self.weight * (self.gain / self._norm())

    def fold(self) -> None:
        """Replace the weights by the normalised ones, which then stay as they are."""
        self.weight = nn.Parameter(self.kernel().detach())
        self.gain = None

    def _norm(self) -> Tensor:
        return wide(self.weight).square().sum((1, 2, 3), keepdim=True).sqrt()


def _side(before: int, after: int, last: float = 0.0) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels, slope in ((before, 0.0), (after, 0.0), (after, last)):
        layers += [NormalisedConv(channels, after, 3, slope), nn.LeakyReLU(slope) if slope else nn.ReLU()]
    return nn.Sequential(*layers)
