"""FLIP: the difference that a person sees when two pictures take turns on the same screen.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, *FLIP: A Difference Evaluator for
Alternating Images*, 2020 (doi:10.1145/3406183), and Andersson, Nilsson, Shirley, Akenine-Möller, *Visualizing
Errors in Rendered High Dynamic Range Images*, 2021 (doi:10.2312/egs.20211015). Equation numbers are those of
the first.

Filters are sums of products of two one-dimensional ones and are applied as such; pixels are worked on in
float32, as in the authors' program.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor

PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * math.pi / 180
"""A screen of 3840 pixels on 0.7 m, seen from 0.7 m: 67 pixels for each degree of the visual field."""

_POWER, _KNEE, _SHOWN = 0.7, 0.4, 0.95
"""q_c, p_c and p_t of equations 18 and 19: how differences of colour become errors between 0 and 1."""
_FEATURE_WIDTH, _FEATURE_POWER = 0.082, 0.5
"""w, the width in degrees of what counts as an edge or a point, and q_f of equation 21."""

_PEAK = 12288897.0
_XYZ = (
    (5067776 / _PEAK, 4394405 / _PEAK, 4435075 / (2 * _PEAK)),
    (2613072 / _PEAK, 8788810 / _PEAK, 887015 / _PEAK),
    (1425312 / (6 * _PEAK), 8788810 / (6 * _PEAK), 70074185 / (6 * _PEAK)),
)
"""From linear sRGB to CIE XYZ (IEC 61966-2-1); rows sum to the white point D65."""

_ACES = (0.36 * 2.51, 0.6 * 0.03, 0.0, 0.36 * 2.43, 0.6 * 0.59, 0.14)
"""The tone curve (a x^2 + b x + c) / (d x^2 + e x + f) of HDR-FLIP: Narkowicz's fit of ACES for 0.6 x."""
_BRIGHT = 0.85
"""Display value at which the exposures of HDR-FLIP begin and end."""


@dataclass(frozen=True)
class _Gaussians:
    """A sensitivity to contrast: sum of `a sqrt(pi / b) exp(-pi^2 r^2 / b)`, r in degrees (equation 4)."""

    a: tuple[float, ...]
    b: tuple[float, ...]


_SENSITIVITY = (
    _Gaussians((1.0,), (0.0047,)),
    _Gaussians((1.0,), (0.0053,)),
    _Gaussians((34.1, 13.5), (0.04, 0.025)),
)
"""Of the achromatic, the red-green and the blue-yellow channel (table 1)."""


def flip_ldr_map(output: Tensor, reference: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Tensor:
    """Return LDR-FLIP of every pixel (B, H, W), 0 where equal, at most 1.

    Args:
        output: Display values in linear sRGB, (B, 3, H, W); clamped to [0, 1].
        reference: What it should be, of the same shape.
        pixels_per_degree: Of the screen as the viewer sees it.
    """
    first, second = (_opponent(_clean(image).clamp(0, 1)) for image in (output, reference))
    ppd = pixels_per_degree
    color = _color_error(_perceived(first, ppd), _perceived(second, ppd))
    feature = _feature_error((first[:, 0] + 16) / 116, (second[:, 0] + 16) / 116, ppd)
    return color.pow(1 - feature)


def flip_hdr_map(output: Tensor, reference: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Tensor:
    """Return HDR-FLIP of every pixel (B, H, W): the largest LDR-FLIP over a range of exposures.

    The range follows from each reference alone; exposure of the arguments does not matter.

    Args:
        output: Linear radiance (B, 3, H, W).
        reference: What it should be, of the same shape.
        pixels_per_degree: Of the screen as the viewer sees it.
    """
    maps = []
    for one, other in zip(_clean(output), _clean(reference), strict=True):
        largest = torch.zeros(other.shape[-2:])
        for stop in exposures(other):
            pair = [_filmic(image * 2.0**stop)[None] for image in (one, other)]
            largest = torch.maximum(largest, flip_ldr_map(pair[0], pair[1], pixels_per_degree)[0])
        maps.append(largest)
    return torch.stack(maps)


def exposures(reference: Tensor) -> list[float]:
    """Return the exposures of HDR-FLIP in stops, ascending.

    The first brings the brightest pixel of a reference (3, H, W) to a display value of 0.85, the last its
    median pixel. A reference without light has one exposure, 0.
    """
    luminance = torch.einsum("c,chw->hw", reference.new_tensor(_XYZ[1]), _clean(reference)).flatten()
    a, b, c, d, e, f = _ACES
    p, q, r = a - _BRIGHT * d, b - _BRIGHT * e, c - _BRIGHT * f
    bright = (-q + math.sqrt(q * q - 4 * p * r)) / (2 * p)
    brightest, middle = float(luminance.max()), float(luminance.median())
    if brightest <= 0:
        return [0.0]
    start, end = (math.log2(bright / max(value, 1e-12)) for value in (brightest, middle))
    count = max(2, math.ceil(end - start))
    return [start + (end - start) * i / (count - 1) for i in range(count)]


def flip_hdr(output: Tensor, reference: Tensor) -> Tensor:
    """Mean HDR-FLIP per image (B,) at 67 pixels per degree, between 0 and 1; linear radiance (B, 3, H, W)."""
    return flip_hdr_map(output, reference).flatten(1).mean(1)


def flip_ldr_srgb(output: Tensor, reference: Tensor) -> Tensor:
    """Mean LDR-FLIP per image (B,) at 67 pixels per degree, of exposed radiance (B, 3, H, W) clipped to 1."""
    return flip_ldr_map(output, reference).flatten(1).mean(1)


def _clean(image: Tensor) -> Tensor:
    return torch.nan_to_num(image.float(), 0.0, 1e12, 0.0).clamp_min(0)


def _filmic(x: Tensor) -> Tensor:
    a, b, c, d, e, f = _ACES
    x = x.clamp_max(1e9)  # its square stays finite; the curve is flat there
    return ((a * x * x + b * x + c) / (d * x * x + e * x + f)).clamp(0, 1)


def _times(matrix: Sequence[Sequence[float]], image: Tensor) -> Tensor:
    return torch.einsum("rc,bchw->brhw", image.new_tensor(matrix), image)


@cache
def _to_rgb() -> list[list[float]]:
    rows: list[list[float]] = torch.linalg.inv(torch.tensor(_XYZ, dtype=torch.float64)).tolist()
    return rows


def _white(image: Tensor) -> Tensor:
    return image.new_tensor([sum(row) for row in _XYZ]).view(1, 3, 1, 1)


def _opponent(rgb: Tensor) -> Tensor:
    """Return YCxCz, a linear form of CIELAB (equation 1), of linear sRGB."""
    x, y, z = (_times(_XYZ, rgb) / _white(rgb)).unbind(1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], 1)


def _rgb(opponent: Tensor) -> Tensor:
    first, second, third = opponent.unbind(1)
    y = (first + 16) / 116
    xyz = torch.stack([y + second / 500, y, y - third / 200], 1) * _white(opponent)
    return _times(_to_rgb(), xyz)


def _perceived(opponent: Tensor, ppd: float) -> Tensor:
    """Return what remains after the eye's blur in CIELAB with Hunt's adjustment (equations 5 to 13)."""
    radius = math.ceil(3 * math.sqrt(max(max(g.b) for g in _SENSITIVITY) / (2 * math.pi**2)) * ppd)
    blurred = [_blurred(opponent[:, i], gaussians, radius, ppd) for i, gaussians in enumerate(_SENSITIVITY)]
    return _hunt(_rgb(torch.stack(blurred, 1)).clamp(0, 1))


def _blurred(channel: Tensor, gaussians: _Gaussians, radius: int, ppd: float) -> Tensor:
    squares = torch.square(torch.arange(-radius, radius + 1, dtype=torch.float64) / ppd)
    lines = [torch.exp(-(math.pi**2) * squares / b) for b in gaussians.b]
    weights = [a * math.sqrt(math.pi / b) for a, b in zip(gaussians.a, gaussians.b, strict=True)]
    total = sum(weight * float(line.sum()) ** 2 for weight, line in zip(weights, lines, strict=True))
    parts = [
        _filtered(_filtered(channel, line, -1), weight / total * line, -2)
        for weight, line in zip(weights, lines, strict=True)
    ]
    return parts[0] if len(parts) == 1 else torch.stack(parts).sum(0)


def _filtered(image: Tensor, line: Tensor, axis: int) -> Tensor:
    """Return an image (B, H, W) filtered along rows (-1) or columns (-2); borders are repeated.

    Sums of shifted images: a convolution of one channel with one line is three times slower.
    """
    radius, size = len(line) // 2, image.shape[axis]
    around = (radius, radius, 0, 0) if axis == -1 else (0, 0, radius, radius)
    padded = F.pad(image, around, mode="replicate")
    total = padded.narrow(axis, 0, size) * float(line[0])
    for place, weight in enumerate(line.tolist()[1:], 1):
        if weight:
            total.add_(padded.narrow(axis, place, size), alpha=weight)
    return total


def _hunt(rgb: Tensor) -> Tensor:
    """Return CIELAB in which dark colours are less colourful (equation 13), of linear sRGB."""
    ratio = _times(_XYZ, rgb) / _white(rgb)
    corner = 6 / 29
    bent = torch.where(
        ratio > corner**3, ratio.clamp_min(corner**3).pow(1 / 3), ratio / (3 * corner**2) + 4 / 29
    )
    x, y, z = bent.unbind(1)
    light = 116 * y - 16
    return torch.stack([light, 0.01 * light * 500 * (x - y), 0.01 * light * 200 * (y - z)], 1)


def _hyab(one: Tensor, other: Tensor) -> Tensor:
    """Return the distance of colours far apart: |L| plus the length of (a, b) (equation 15)."""
    apart = one - other
    return apart[:, 0].abs() + torch.hypot(apart[:, 1], apart[:, 2])


@cache
def _farthest() -> float:
    """Return the largest difference of colours, between green and blue."""
    green, blue = (_hunt(torch.tensor(c).view(1, 3, 1, 1)) for c in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    return float(_hyab(green, blue)) ** _POWER


def _color_error(one: Tensor, other: Tensor) -> Tensor:
    """Return errors in [0, 1]: the lower 40 % of differences take 95 % of the range (equation 19)."""
    error, largest = _hyab(one, other).pow(_POWER), _farthest()
    knee = _KNEE * largest
    above = _SHOWN + (error - knee) / (largest - knee) * (1 - _SHOWN)
    return torch.where(error < knee, error * (_SHOWN / knee), above).clamp(0, 1)


def _feature_error(one: Tensor, other: Tensor, ppd: float) -> Tensor:
    """Return how differently edges and points stand out, in [0, 1] (equations 20 to 22)."""
    sigma = 0.5 * _FEATURE_WIDTH * ppd
    radius = math.ceil(3 * sigma)
    place = torch.arange(-radius, radius + 1, dtype=torch.float64)
    bell = torch.exp(-torch.square(place / sigma) / 2)
    detectors = [-place * bell, (torch.square(place / sigma) - 1) * bell]
    detectors = [
        torch.where(line > 0, line / line.clamp_min(0).sum(), -line / line.clamp_max(0).sum())
        for line in detectors
    ]
    lengths = []
    for image in (one, other):
        smooth = [_filtered(image, bell / bell.sum(), axis) for axis in (-2, -1)]
        lengths.append(
            [
                torch.hypot(_filtered(smooth[0], line, -1), _filtered(smooth[1], line, -2))
                for line in detectors
            ]
        )
    differences = [(first - second).abs() for first, second in zip(*lengths, strict=True)]
    return (torch.maximum(*differences) / math.sqrt(2)).pow(_FEATURE_POWER).clamp(0, 1)
