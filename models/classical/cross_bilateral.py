"""Bilateral filter of the colour, with weights from a smoothed copy of it.

Carlo Tomasi, Roberto Manduchi: "Bilateral filtering for gray and color images", ICCV 1998,
doi:10.1109/ICCV.1998.710815, equation 2 of NFOR (`models.classical.nfor`); noise in the weights is reduced
by comparing colours of a low-passed image, as there after Ruifeng Xu, Sumanta Pattanaik: "A novel Monte Carlo
noise reduction operator", IEEE Computer Graphics and Applications 25(2), 2005, doi:10.1109/MCG.2005.31.
Colours are compared as log(1 + exposed radiance), since bandwidths of radiance itself fit either shadows or
lights. Equation 7, with features in the weights, is `models.classical.joint_bilateral`.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from models.denoiser import Buffers, Denoised, Denoiser


class CrossBilateral(Denoiser):
    """Bilateral filter of (2 radius + 1) squared pixels.

    The weight of a pixel is exp(-|p - q|^2 / (2 spatial^2) - |g_p - g_q|^2 / (2 tonal^2)); g is
    log(1 + exposure * color) smoothed by a Gaussian. Pixels outside the image take no part.

    Args:
        radius: Half the window.
        spatial: Bandwidth in pixels.
        tonal: Bandwidth of the logarithmic colours, Euclidean distance in RGB.
        smoothing: Sigma in pixels of the Gaussian on the colours that are compared, 0: none (equation 2).
    """

    inputs = ("color",)
    frame_numbers = ("exposure",)

    def __init__(
        self, radius: int = 6, spatial: float = 3.0, tonal: float = 0.2, smoothing: float = 1.0
    ) -> None:
        super().__init__()
        if radius < 1:
            raise ValueError(f"CrossBilateral: radius must be at least 1, got {radius}")
        for name, value in (("spatial", spatial), ("tonal", tonal)):
            if not value > 0:
                raise ValueError(f"CrossBilateral: bandwidth {name} must be positive, got {value}")
        if smoothing < 0:
            raise ValueError(f"CrossBilateral: smoothing must be at least 0, got {smoothing}")
        self.radius, self.spatial, self.tonal, self.smoothing = radius, spatial, tonal, smoothing
        self.halo = radius + self._reach()

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color` (B, 3, H, W), linear radiance; optionally `exposure` (B,).
        """
        self.check(buffers)
        color = buffers["color"].float()
        height, width = color.shape[-2:]
        guide = self._smoothed(torch.log1p((color * self.exposure(buffers)).clamp_min(0)))
        inside = torch.ones_like(color[:, :1])
        joined = torch.cat([color, inside, guide], 1)
        around = F.pad(joined, [self.radius] * 4)
        total = torch.zeros_like(joined[:, :4])
        steps = range(-self.radius, self.radius + 1)
        for down, right in ((y, x) for y in steps for x in steps):
            top, left = self.radius + down, self.radius + right
            there = around[..., top : top + height, left : left + width]
            distance = (there[:, 4:] - guide).square().sum(1, keepdim=True) / (2 * self.tonal**2)
            near = (down * down + right * right) / (2 * self.spatial**2)
            total = total + torch.exp(-distance - near) * there[:, :4]
        return Denoised(total[:, :3] / total[:, 3:])

    def _reach(self) -> int:
        return math.ceil(2 * self.smoothing)

    def _smoothed(self, guide: Tensor) -> Tensor:
        """Smooth; the Gaussian is cut at 2 sigma, and at the border normalised over what is inside."""
        reach = self._reach()
        if reach == 0:
            return guide
        taps = [math.exp(-(x * x) / (2 * self.smoothing**2)) for x in range(-reach, reach + 1)]
        joined = torch.cat([guide, torch.ones_like(guide[:, :1])], 1)
        height, width = guide.shape[-2:]
        rows = F.pad(joined, [reach] * 4)
        tall = torch.stack([t * rows[..., i : i + height, :] for i, t in enumerate(taps)]).sum(0)
        both = torch.stack([t * tall[..., i : i + width] for i, t in enumerate(taps)]).sum(0)
        return both[:, :3] / both[:, 3:]
