"""Edge-stopping weights of SVGF, and weighted means with them over taps that lie far apart.

The weight of neighbour q for pixel p, with normals n, depths z, luminances l of what is filtered, the slope
of the depth at p, and kernel numbers k,

    w(p, q) = k(q - p) max(0, n_p n_q)^sigma_n exp(-|z_p - z_q| / (sigma_z max(d, 1e-8)) - |l_p - l_q| / r_p)

(Schied et al. 2017, doi:10.1145/3105762.3105770, equations 2 to 5), where d is what the depth may change by
from p to q: the steeper of both slopes times their distance, as in released code (`steepest`), or the slope
in their direction times it, as in the paper (`along`). r says how different luminances may be. The pixel's
own weight is k(0); pixels outside the image and those that hit nothing take no part.

Works on whole images, one tap after the other, so that no array grows with the number of taps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.slopes import slopes

Slope = Literal["steepest", "along"]
"""What the depth may change by."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue (Rec. 709)."""

_FLATTEST = 1e-8
"""Least change of depth that counts, in scene units: keeps flat surfaces from dividing by 0."""

_EDGE = (1.0, 2 / 3, 1 / 6)
"""A-trous kernel along one axis at distance 0, 1 and 2, proportional to 3/8, 1/4, 1/16."""


@dataclass(frozen=True)
class Tap:
    """One neighbour and its kernel number."""

    down: int
    right: int
    kernel: float


def atrous_taps(step: int) -> list[Tap]:
    """Return the 25 taps of an a-trous iteration, `step` pixels apart."""
    reach = range(-2, 3)
    return [Tap(y * step, x * step, _EDGE[abs(y)] * _EDGE[abs(x)]) for y in reach for x in reach]


def box_taps(radius: int) -> list[Tap]:
    """Return all neighbours of a square, each with kernel number 1."""
    reach = range(-radius, radius + 1)
    return [Tap(y, x, 1.0) for y in reach for x in reach]


@dataclass(frozen=True)
class EdgeStops:
    """How different neighbours may be.

    Attributes:
        depth: sigma_z.
        normal: sigma_n, an exponent.
        slope: See the module.
    """

    depth: float = 1.0
    normal: float = 128.0
    slope: Slope = "steepest"


class Surfaces:
    """What pixels show, with room around it for taps.

    Args:
        normal: Unit vectors (B, 3, H, W), 0 where there is none.
        depth: (B, 1, H, W), 0 where nothing was hit.
        reach: Pixels to the farthest tap.
        stops: How different neighbours may be.
    """

    def __init__(self, normal: Tensor, depth: Tensor, reach: int, stops: EdgeStops) -> None:
        self.reach, self.stops, self.size = reach, stops, tuple(depth.shape[-2:])
        self.hit = (depth > 0).to(depth.dtype)
        self.normal, self.depth = normal, depth
        self._right, self._down = slopes(depth)
        self._steepest = torch.maximum(self._right.abs(), self._down.abs())
        self._around = F.pad(torch.cat([normal, depth, self.hit], 1), [reach] * 4)

    def padded(self, image: Tensor) -> Tensor:
        """Return an image with room around it, for `near`."""
        return F.pad(image, [self.reach] * 4)

    def near(self, padded: Tensor, tap: Tap) -> Tensor:
        """Return what neighbours hold in an image with room around it."""
        top, left = self.reach + tap.down, self.reach + tap.right
        return padded[..., top : top + self.size[0], left : left + self.size[1]]

    def weights(self, tap: Tap) -> tuple[Tensor, Tensor]:
        """Return what of a tap's weight stands before the exponential, and the depth's part in it."""
        around = self.near(self._around, tap)
        normal, depth, hit = around[:, :3], around[:, 3:4], around[:, 4:]
        alike = (self.normal * normal).sum(1, keepdim=True).clamp(0.0, 1.0).pow(self.stops.normal)
        if self.stops.slope == "steepest":
            change = self._steepest * (tap.down**2 + tap.right**2) ** 0.5
        else:
            change = (self._right * tap.right + self._down * tap.down).abs()
        apart = (self.depth - depth).abs() / (self.stops.depth * change.clamp_min(_FLATTEST))
        return tap.kernel * alike * hit * self.hit, apart


class Means(NamedTuple):
    """Weighted means.

    Attributes:
        values: sum w x / sum w, (B, C, H, W).
        variances: sum w^2 x / (sum w)^2, (B, D, H, W): what a variance becomes in such a mean.
    """

    values: Tensor
    variances: Tensor


def edge_stopping_means(
    values: Tensor, variances: Tensor, spread: Tensor, surfaces: Surfaces, taps: Sequence[Tap]
) -> Means:
    """Return weighted means around every pixel.

    Args:
        values: (B, C, H, W); the first three channels are the colour whose luminance is compared.
        variances: (B, D, H, W), D may be 0.
        spread: r, (B, 1, H, W) or a single number, positive.
        surfaces: What pixels show.
        taps: The neighbours, with the pixel itself.
    """
    light = luminance(values[:, :3])
    count = values.shape[1]
    around = surfaces.padded(torch.cat([values, variances, light], 1))
    total, squares = torch.zeros_like(values), torch.zeros_like(variances)
    norm = torch.zeros_like(light)
    for tap in taps:
        near = surfaces.near(around, tap)
        if tap.down == tap.right == 0:
            weight = torch.full_like(light, tap.kernel)
        else:
            front, apart = surfaces.weights(tap)
            weight = front * torch.exp(-apart - (light - near[:, -1:]).abs() / spread)
        total = total + weight * near[:, :count]
        squares = squares + weight.square() * near[:, count:-1]
        norm = norm + weight
    return Means(total / norm, squares / norm.square())


def luminance(color: Tensor) -> Tensor:
    """Return the luminance (B, 1, H, W) of linear colours (B, 3, H, W)."""
    return (color * color.new_tensor(LUMINANCE)[:, None, None]).sum(1, keepdim=True)


def smoothed_variance(variance: Tensor) -> Tensor:
    """Return the mean over 3x3 pixels with weights 1/4, 1/8, 1/16; of those inside the image.

    Args:
        variance: (B, 1, H, W).
    """
    joined = F.pad(torch.cat([variance, torch.ones_like(variance)], 1), [1] * 4)
    rows = joined[..., :-2, :] + 2 * joined[..., 1:-1, :] + joined[..., 2:, :]
    both = rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]
    return both[:, :1] / both[:, 1:]
