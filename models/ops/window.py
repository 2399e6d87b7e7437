"""Window sums of exp(map), for maps of any range.

exp overflows above 88, and one common shift underflows whole windows to 0 / 0 as soon as a map spans more
than about 150, while a shift per window cannot be shared by window sums. (The published weights of WSKP
reach a span of 122 on one-sample frames.) So a map is cut into bands of 112, measured down from its largest
value. Within a band exp stays in e**-56 … e**56; every band gets window sums of its own, and a pixel combines
them relative to the highest band that its window holds. That is exact for every finite map. A map that
spans less than 112, the common case, has one band and costs nothing extra; bands without pixels are skipped.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.ops.boxes import box_sum_valid

SPAN = 112.0
"""Width of a band. Sums over 169 pixels of e**56 times radiance up to 1e9, and gradients down to 1e-11
divided by them, are normal numbers of float32."""


class LogMap(NamedTuple):
    """A map whose exp is summed.

    Attributes:
        values: (B, 1, H, W), finite.
        top: (B, 1, 1, 1), the maximum of each sample rounded up. Whole numbers keep `top - SPAN * band`
            free of rounding however high the map lies.
        half: (B, 1, 1, 1), whole numbers: how far the centre of the uppermost band lies below `top`; half of
            the range of a sample that has one band, so that exponents are small and rounded finely.
        bands: The bands that hold pixels, counted down from `top`, in ascending order.
    """

    values: Tensor
    top: Tensor
    half: Tensor
    bands: list[int]

    def energy(self, band: int, rows: slice) -> Tensor:
        """Return exp(values) of the pixels of one band relative to its centre, 0 elsewhere."""
        values = self.values[:, :, rows]
        shifted = values - (self.top - (SPAN * band + self.half))
        if len(self.bands) == 1:
            return shifted.exp_()
        inside = ((self.top - values) / SPAN).floor_() == band
        return torch.where(inside, shifted.clamp_(-SPAN / 2 - 1, SPAN / 2 + 1).exp_(), 0.0)


class Window(NamedTuple):
    """Sums over the windows around some rows.

    Attributes:
        sums: (B, 4, rows, W): of energy times irradiance, and of energy.
        highest: (B, 1, rows, W): the highest band in each window, whose centre the sums are relative to;
            None where the map has one band.
    """

    sums: Tensor
    highest: Tensor | None


def log_maps(stack: Tensor) -> list[LogMap]:
    """Split (B, K, H, W) into K maps and find the bands of each."""
    stack = stack.detach()
    tops = stack.amax((-2, -1), keepdim=True).ceil()
    depth = tops - stack.amin((-2, -1), keepdim=True)
    half = torch.where(depth < SPAN, depth / 2, SPAN / 2).floor()
    maps = []
    for index, deepest in enumerate(depth.amax((0, 2, 3)).tolist()):
        one = slice(index, index + 1)
        bands = [0]
        if deepest >= SPAN:
            bands = [int(b) for b in torch.unique(((tops - stack)[:, one] / SPAN).floor_()).tolist()]
        maps.append(LogMap(stack[:, one], tops[:, one], half[:, one], bands))
    return maps


def window_sums(irradiance: Tensor, log_map: LogMap, size: int, start: int, stop: int) -> Window:
    """Sum size x size windows, cut at the image border, around the pixels of rows start … stop - 1."""
    first, *lower = log_map.bands
    sums = _band_sums(irradiance, log_map, first, size, (start, stop))
    if not lower:
        return Window(sums, None)
    highest = torch.full_like(sums[:, 3:], first)
    for band in lower:
        below = _band_sums(irradiance, log_map, band, size, (start, stop))
        empty = sums[:, 3:] == 0
        # e**-SPAN alone would underflow: its root is applied twice.
        root = torch.where(empty, 1.0, torch.exp(SPAN / 2 * (highest - band)))
        sums = sums + below * root * root
        highest = torch.where(empty, float(band), highest)
    return Window(sums, highest)


def _band_sums(irradiance: Tensor, log_map: LogMap, band: int, size: int, rows: tuple[int, int]) -> Tensor:
    batch, _, height, width = irradiance.shape
    radius, (start, stop) = size // 2, rows
    first, last = max(0, start - radius), min(height, stop + radius)
    padded = irradiance.new_zeros(batch, 4, stop - start + 2 * radius, width + 2 * radius)
    top = first - (start - radius)
    image = padded[:, :, top : top + last - first, radius : radius + width]
    energy = log_map.energy(band, slice(first, last))
    image[:, 3:] = energy
    torch.mul(irradiance[:, :, first:last], energy, out=image[:, :3])
    return box_sum_valid(padded, size)


def to_band(adjoint: Tensor, highest: Tensor | None, band: int) -> Tensor:
    """Bring a quotient by window sums from the highest band of each window to `band`.

    Windows whose highest band lies below `band` hold no pixel of it and give 0.
    """
    if highest is None:
        return adjoint
    root = torch.exp((SPAN / 2 * (highest - band)).clamp_max(0.0))
    return adjoint * torch.where(highest <= band, root, 0.0) * root
