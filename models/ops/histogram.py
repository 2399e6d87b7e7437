"""Averages of patches whose ray histograms are alike, one window offset at a time.

Mauricio Delbracio et al.: "Boosting Monte Carlo rendering by ray histogram fusion", ACM Transactions on
Graphics 33(1), 2014, doi:10.1145/2532708. With the histogram h of a pixel's samples and their number n, the
distance of two patches is the mean over their pixels, over colour channels and bins of

    (n_q h_p - n_p h_q)^2 / (n_p n_q (h_p + h_q)) = n_p n_q (h_p / n_p - h_q / n_q)^2 / (h_p + h_q)

where bins with h_p + h_q <= 1, and pixels without samples, do not count. Patches nearer than a threshold are
accepted, with equal weights, and so are a number of nearest ones and the patch itself. The mean of the
accepted patches is an estimate of the whole patch; a pixel is the mean of the estimates of all patches that
it lies in.

At the border patches shrink: the radius of the patch around a pixel is at most its distance from the border,
and neighbours are those whose patch of that radius lies in the image.

Everything works on whole images per offset. What pixels contribute is one image per offset, whose box sums
are the distances of all patches; an offset and its opposite share it. The second sweep spreads 1 / (number of
accepted patches) over each patch, and so has the weight of a pixel's neighbour at that offset. The centre
counts like any other offset, so constant images stay constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import HISTOGRAM_BINS
from data.histograms import GAMMA, LARGEST, SATURATION
from models.ops.boxes import box_sum_valid, exporting
from models.ops.nlm import strips
from models.ops.pyramid import coarser
from models.pace import tick

LEAST = 1.0
"""Bins with no more than this in both histograms together do not count."""

EPSILON = 1e-4
"""Added to the number of bins that count."""


@dataclass(frozen=True)
class HistogramKernel:
    """How patches are compared.

    Attributes:
        window: Radius R of the window, (2 R + 1)^2 pixels.
        patch: Radius F of a patch.
        threshold: kappa, distance below which patches are accepted.
        nearest: How many of the nearest patches are accepted whatever their distance, beside the patch
            itself.
    """

    window: int = 6
    patch: int = 1
    threshold: float = 0.8
    nearest: int = 2

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.window < 1 or self.patch < 0:
            raise ValueError(
                f"histogram fusion needs a window radius >= 1 and a patch radius >= 0, "
                f"got {self.window} and {self.patch}"
            )
        if not self.threshold > 0 or self.nearest < 0:
            raise ValueError(
                f"histogram fusion needs a threshold > 0 and a number of nearest patches >= 0, "
                f"got {self.threshold} and {self.nearest}"
            )

    @property
    def reach(self) -> int:
        """How far a pixel looks: to its patch's centre, along the window, over the other patch."""
        return self.window + 2 * self.patch

    @property
    def offsets(self) -> list[tuple[int, int]]:
        """Rows down and columns to the right of every neighbour, row by row."""
        along = range(-self.window, self.window + 1)
        return [(down, right) for down in along for right in along]


def sample_histogram(radiance: Tensor, exposure: Tensor | float = 1.0) -> Tensor:
    """Return the histograms of samples; the formula is in `data.histograms`.

    Args:
        radiance: Linear radiance (B, S, 3, H, W); samples that are not finite in every channel do not count.
        exposure: Brings it to a displayable level; broadcasts to (B, 3, H, W).

    Returns:
        (B, 60, H, W): 20 bins of red, of green, of blue.
    """
    batch, _, channels, height, width = radiance.shape
    result = radiance.new_zeros(batch, channels, HISTOGRAM_BINS, height, width)
    last = HISTOGRAM_BINS - 2
    for sample in radiance.unbind(1):
        weight = sample.isfinite().all(1, keepdim=True).to(sample.dtype)
        light = torch.nan_to_num(sample, 0.0, 0.0, 0.0).clamp_min(0.0) * exposure
        value = (light.pow(1 / GAMMA) / LARGEST).clamp_max(SATURATION)
        low = (value * last).floor().clamp_max(last)
        upper = torch.where(low < last, value * last - low, (value - 1) / (SATURATION - 1)).clamp(0, 1)
        place = low.long()[:, :, None]
        upper = (upper * weight)[:, :, None]
        result.scatter_add_(2, place, weight[:, :, None] - upper)
        result.scatter_add_(2, place + 1, upper)
    return result.flatten(1, 2)


def coarser_histogram(histogram: Tensor) -> Tensor:
    """Return the histograms (B, C, H / 2, W / 2) of pixels twice as large, with four times the samples.

    The low pass of `models.ops.pyramid` times 4: where all pixels have equally many samples, the image keeps
    their number.
    """
    return torch.cat([4 * coarser(part) for part in histogram.split(HISTOGRAM_BINS, 1)], 1)


def histogram_filter(
    image: Tensor, histogram: Tensor, kernel: HistogramKernel, budget: float | None = None
) -> Tensor:
    """Filter an image with patches that are alike in their histograms.

    Args:
        image: (B, C, H, W).
        histogram: (B, 60, H, W); it gets no gradient, since patches are accepted or not.
        kernel: How patches are compared.
        budget: Working memory in bytes, which sets the height of the strips that are worked on; see
            `models.ops.nlm.strips`.

    Returns:
        (B, C, H, W).
    """
    batch, height, width = image.shape[0], *image.shape[-2:]
    with torch.no_grad():
        pixels = _Pixels(histogram.detach(), kernel)
    padded = F.pad(image, [kernel.window] * 4)
    planes = 4 * histogram.shape[1] + 2 * len(kernel.offsets) + 4 * image.shape[1]
    row_bytes = image.element_size() * batch * planes * width
    result = []
    for rows in [(0, height)] if exporting() else strips(height, row_bytes, budget, image.device):
        with torch.no_grad():
            accepted = pixels.accepted(rows)
        result.append(_fused(padded, pixels, accepted, rows))
        tick((rows[1] - rows[0]) / height)
    return result[0] if len(result) == 1 else torch.cat(result, -2)


class _Terms(NamedTuple):
    """What pixels towards one offset contribute to distances: the sum of bins, and how many count."""

    total: Tensor
    number: Tensor

    def cut(self, top: int, height: Tensor | int, left: int, width: Tensor | int) -> _Terms:
        """Return a part."""
        part = (..., slice(top, top + height), slice(left, left + width))
        return _Terms(self.total[part], self.number[part])


class _Pixels:
    """Histograms of an image, padded by zeros, and the radius of the patch around each pixel."""

    def __init__(self, histogram: Tensor, kernel: HistogramKernel) -> None:
        self.kernel = kernel
        self.size = histogram.shape[-2:]
        self.pad = kernel.reach
        clean = torch.nan_to_num(histogram, 0.0, 0.0, 0.0).clamp_min(0.0)
        self.histogram = F.pad(clean, [self.pad] * 4)
        groups = self.histogram.shape[1] // HISTOGRAM_BINS
        self.number = self.histogram.sum(1, keepdim=True) / groups
        self.share = self.histogram / torch.where(self.number > 0, self.number, 1.0)
        # The distance from the border; negative outside.
        self.down = self._distance(self.size[0])
        self.across = self._distance(self.size[1])

    def accepted(self, rows: tuple[int, int]) -> list[Tensor]:
        """Return which patches are accepted, bool (B, 1, h + 2 F, W) for every offset.

        Args:
            rows: Start and stop; patches around F rows more above and below are looked at, since they reach
                in.
        """
        distances = self._distances(rows)
        offsets = self.kernel.offsets
        found = [distances[offset] < self.kernel.threshold for offset in offsets]
        nearest = self._nearest([distances[offset] for offset in offsets])
        radius = self.radius(rows)
        for place, offset in enumerate(offsets):
            for other in nearest:
                found[place] = found[place] | (other == place)
            if offset == (0, 0):
                found[place] = found[place] | (radius >= 0)
        return found

    def radius(self, rows: tuple[int, int]) -> Tensor:
        """Return the radius of the patch around pixels of these rows and F more, negative outside."""
        return torch.minimum(self._rows_from_border(rows), self.across[self._columns(0)]).clamp_max(
            self.kernel.patch
        )

    def _rows_from_border(self, rows: tuple[int, int], down: int = 0) -> Tensor:
        (start, stop), patch = rows, self.kernel.patch
        return self.down[start - patch + self.pad + down : stop + patch + self.pad + down, None]

    def _columns(self, right: int) -> slice:
        return slice(self.pad + right, self.pad + right + self.size[1])

    def _distance(self, size: int) -> Tensor:
        place = torch.arange(-self.pad, size + self.pad, device=self.histogram.device)
        return torch.minimum(place, size - 1 - place)

    def _distances(self, rows: tuple[int, int]) -> dict[tuple[int, int], Tensor]:
        """Return offset → distances (B, 1, h + 2 F, W), infinite where there is no such neighbour."""
        patch, radius = self.kernel.patch, self.radius(rows)
        height, width = rows[1] - rows[0] + 4 * patch, self.size[1] + 2 * patch
        result = {}
        for down, right in self.kernel.offsets[len(self.kernel.offsets) // 2 :]:
            terms = self._terms((down, right), rows)
            before, after = max(right, 0), max(-right, 0)
            ways = [(down, right, terms.cut(down, height, before, width))]
            if (down, right) != (0, 0):
                ways.append((-down, -right, terms.cut(0, height, after, width)))
            for way_down, way_right, part in ways:
                border = torch.minimum(
                    self._rows_from_border(rows, way_down), self.across[self._columns(way_right)]
                )
                there = (radius >= 0) & (border >= radius)
                result[way_down, way_right] = torch.where(there, _patch_means(part, radius, patch), torch.inf)
        return result

    def _terms(self, offset: tuple[int, int], rows: tuple[int, int]) -> _Terms:
        """Return the terms of all pixels that patches of these rows need, of this offset and its opposite.

        Rows begin 2 F + down above, columns F and what the offset goes to the right before the first.
        """
        (start, stop), (down, right), patch = rows, offset, self.kernel.patch
        top, bottom = start - 2 * patch - down + self.pad, stop + 2 * patch + self.pad
        left = self.pad - patch - max(right, 0)
        width = self.size[1] + 2 * patch + abs(right)
        p = (..., slice(top, bottom), slice(left, left + width))
        q = (..., slice(top + down, bottom + down), slice(left + right, left + right + width))
        both = F.threshold(self.histogram[p] + self.histogram[q], LEAST, torch.inf, inplace=True)
        square = (self.share[p] - self.share[q]).square_()
        counts = self.number[p] * self.number[q]
        number = both.isfinite().sum(1, keepdim=True) * (counts > 0)
        return _Terms(square.div_(both).sum(1, keepdim=True) * counts, number.to(counts.dtype))

    def _nearest(self, distances: list[Tensor]) -> list[Tensor]:
        """Return the places of the nearest neighbours, the first of equal ones; -1: there is none."""
        centre = len(distances) // 2
        best = [torch.full_like(distances[0], torch.inf) for _ in range(self.kernel.nearest)]
        places = [torch.full_like(distances[0], -1.0) for _ in best]
        for number, distance in enumerate(distances):
            if number == centre or not best:
                continue
            place = torch.full_like(distance, float(number))
            for rank in range(len(best)):
                closer = distance < best[rank]
                best[rank], distance = (
                    torch.where(closer, distance, best[rank]),
                    torch.where(closer, best[rank], distance),
                )
                places[rank], place = (
                    torch.where(closer, place, places[rank]),
                    torch.where(closer, places[rank], place),
                )
        return places


def _patch_means(terms: _Terms, radius: Tensor, patch: int) -> Tensor:
    """Return the mean of the terms over each patch; its radius is at most that of the terms' margin."""
    result: Tensor | None = None
    for size in range(patch + 1):
        margin, side = patch - size, 2 * size + 1
        height, width = terms.total.shape[-2] - 2 * margin, terms.total.shape[-1] - 2 * margin
        total, number = (box_sum_valid(part, side) for part in terms.cut(margin, height, margin, width))
        mean = total / (number + EPSILON)
        result = mean if result is None else torch.where(radius >= size, mean, result)
    assert result is not None
    return result


def _fused(image: Tensor, pixels: _Pixels, accepted: list[Tensor], rows: tuple[int, int]) -> Tensor:
    """Return rows of the mean of all estimates; image: padded by the radius of the window."""
    kernel, (start, stop) = pixels.kernel, rows
    radius, width = pixels.radius(rows), pixels.size[1]
    share = torch.stack(accepted).sum(0).clamp_min(1).to(image.dtype).reciprocal()
    total: Tensor | None = None
    norm: Tensor | None = None
    for mask, (down, right) in zip(accepted, kernel.offsets, strict=True):
        weight = _spread(torch.where(mask, share, 0.0), radius, kernel.patch)
        top, left = kernel.window + down, kernel.window + right
        q = image[..., top + start : top + stop, left : left + width]
        total = weight * q if total is None else torch.addcmul(total, weight, q)
        norm = weight if norm is None else norm + weight
    assert total is not None
    assert norm is not None
    return total / norm


def _spread(weight: Tensor, radius: Tensor, patch: int) -> Tensor:
    """Spread the weight of each patch over its pixels: (B, 1, h + 2 F, W) to (B, 1, h, W)."""
    result: Tensor | None = None
    for size in range(patch + 1):
        margin = patch - size
        part = torch.where(radius == size, weight, 0.0)
        part = part[..., margin : part.shape[-2] - margin, :]
        part = box_sum_valid(F.pad(part, (size, size, 0, 0)), 2 * size + 1)
        result = part if result is None else result + part
    assert result is not None
    return result
