"""Edge-stopping weights of SVGF, and weighted means with them over taps that lie far apart.

The weight of neighbour q for pixel p, with normals n, depths z, luminances l of what is filtered, the slope
of the depth at p, and kernel numbers k,

    w(p, q) = k(q - p) max(0, n_p n_q)^sigma_n exp(-|z_p - z_q| / (sigma_z max(d, 1e-8)) - |l_p - l_q| / r_p)

(Schied et al. 2017, doi:10.1145/3105762.3105770), where d is what the depth may change by from p to q:
the steeper of both slopes times their distance, as in released code (`steepest`), or the slope in their
direction times it, as in the paper (`along`). r says how different luminances may be. The pixel's own weight
is k(0); pixels outside the image and those that hit nothing take no part.

Works on images, one tap after the other, so that no array grows with the number of taps; on a CPU some rows
at a time, or by compiled kernels where sigma_n is a power of 2 (`models.ops.fused.edges`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.nlm import use_fused
from models.ops.slopes import slopes

Slope = Literal["steepest", "along"]
"""What the depth may change by."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue (Rec. 709)."""

_FLATTEST = 1e-8
"""Least change of depth that counts, in scene units: keeps flat surfaces from dividing by 0."""

_PIXELS = 1 << 15
"""Pixels done at a time on a CPU."""

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

    Attributes:
        own: Normal, depth, slopes to the right and downwards (B, 6, H, W). Where nothing was hit, and
            outside, a normal of 0 keeps pixels apart from all others.
        around: Normal and depth with room around them.
    """

    def __init__(self, normal: Tensor, depth: Tensor, reach: int, stops: EdgeStops) -> None:
        self.reach, self.stops = reach, stops
        self.height, self.width = depth.shape[-2:]
        self.own = torch.cat([normal * (depth > 0), depth, *slopes(depth)], 1)
        self.around = self.padded(self.own[:, :4])

    def doublings(self) -> int | None:
        """Return how often a cosine is squared to be raised to sigma_n, None where that is no power of 2."""
        mantissa, exponent = math.frexp(self.stops.normal)
        return exponent - 1 if mantissa == 0.5 and exponent >= 1 else None

    def padded(self, image: Tensor) -> Tensor:
        """Return an image with room around it, for `near`."""
        return F.pad(image, [self.reach] * 4)

    def near(self, padded: Tensor, tap: Tap, rows: slice) -> Tensor:
        """Return what neighbours of some rows hold, in an image with room around it."""
        top, left = self.reach + tap.down, self.reach + tap.right
        return padded[..., top + rows.start : top + rows.stop, left : left + self.width]

    def weights(self, tap: Tap, rows: slice) -> tuple[Tensor, Tensor]:
        """Return what of a tap's weight stands before the exponential, and the depth's part in it.

        Args:
            tap: The neighbour.
            rows: Which of the pixels.
        """
        own, around = self.own[..., rows, :], self.near(self.around, tap, rows)
        alike = (own[:, :3] * around[:, :3]).sum(1, keepdim=True).clamp(0.0, 1.0).pow(self.stops.normal)
        right, down = own[:, 4:5], own[:, 5:]
        if self.stops.slope == "steepest":
            change = torch.maximum(right.abs(), down.abs()) * (tap.down**2 + tap.right**2) ** 0.5
        else:
            change = (right * tap.right + down * tap.down).abs()
        apart = (own[:, 3:4] - around[:, 3:]).abs() / (self.stops.depth * change.clamp_min(_FLATTEST))
        return tap.kernel * alike, apart


class Means(NamedTuple):
    """Weighted means.

    Attributes:
        values: sum w x / sum w, (B, C, H, W).
        variances: sum w^2 x / (sum w)^2, (B, D, H, W): what a variance becomes in such a mean.
    """

    values: Tensor
    variances: Tensor


def edge_stopping_means(
    values: Tensor,
    variances: Tensor,
    spread: Tensor,
    surfaces: Surfaces,
    taps: Sequence[Tap],
    *,
    fused: bool | None = None,
) -> Means:
    """Return weighted means around every pixel.

    Args:
        values: (B, C, H, W); the first three channels are the colour whose luminance is compared.
        variances: (B, D, H, W), D may be 0.
        spread: r, (B, 1, H, W) or a single number, positive.
        surfaces: What pixels show.
        taps: The neighbours, with the pixel itself.
        fused: See `models.ops.nlm.use_fused`.
    """
    light = luminance(values[:, :3])
    around = surfaces.padded(torch.cat([light, values, variances], 1))
    spread = spread.expand_as(light)
    if use_fused(fused, around, spread, surfaces.own) and surfaces.doublings() is not None:
        return _fused_means(around, values.shape[1], spread, surfaces, taps)
    parts = [_means_of_rows(around, values.shape[1], spread, surfaces, taps, rows) for rows in _strips(light)]
    return Means(*(torch.cat(part, -2) for part in zip(*parts, strict=True)))


def _fused_means(
    around: Tensor, count: int, spread: Tensor, surfaces: Surfaces, taps: Sequence[Tap]
) -> Means:
    """Return what `edge_stopping_means` does, by compiled kernels."""
    from models.ops import fused

    places = np.array([(tap.down, tap.right) for tap in taps], np.int64)
    kernels = np.array([tap.kernel for tap in taps], np.float32)
    stops, found = surfaces.stops, []
    for b in range(len(around)):
        edges = fused.Edges(
            surfaces.own[b].numpy(),
            surfaces.around[b].numpy(),
            surfaces.reach,
            surfaces.doublings() or 0,
            np.float32(stops.depth),
            np.float32(_FLATTEST),
            stops.slope == "steepest",
        )
        given = (around[b].numpy(), count, spread[b, 0].contiguous().numpy(), places, kernels)
        found.append(torch.from_numpy(fused.edge_means(edges, *given, torch.get_num_threads())))
    means = torch.stack(found)
    return Means(means[:, :count], means[:, count:])


def _means_of_rows(
    around: Tensor, count: int, spread: Tensor, surfaces: Surfaces, taps: Sequence[Tap], rows: slice
) -> Means:
    """Return the means of some rows; `around` holds luminance, `count` values, and variances."""
    own = surfaces.near(around, Tap(0, 0, 1.0), rows)
    light, different = own[:, :1], spread[..., rows, :]
    values, variances = slice(1, 1 + count), slice(1 + count, None)
    total, squares = torch.zeros_like(own[:, values]), torch.zeros_like(own[:, variances])
    norm = torch.zeros_like(light)
    for tap in taps:
        near = surfaces.near(around, tap, rows)
        if tap.down == tap.right == 0:
            weight = torch.full_like(light, tap.kernel)
        else:
            front, apart = surfaces.weights(tap, rows)
            weight = front * torch.exp(-apart - (light - near[:, :1]).abs() / different)
        total = torch.addcmul(total, weight, near[:, values])
        squares = torch.addcmul(squares, weight.square(), near[:, variances])
        norm = norm + weight
    return Means(total / norm, squares / norm.square())


def _strips(image: Tensor) -> list[slice]:
    """Return rows that are done together: a processor's cache holds what becomes of them."""
    height, width = image.shape[-2:]
    step = max(1, _PIXELS // width) if image.device.type == "cpu" and not exporting() else height
    return [slice(top, min(top + step, height)) for top in range(0, height, step)]


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
