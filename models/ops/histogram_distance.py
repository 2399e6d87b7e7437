"""Distances of patches of ray histograms, and which patches are accepted: `models.ops.histogram` says how."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import HISTOGRAM_BINS
from models.ops.boxes import box_sum_valid

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


class _Terms(NamedTuple):
    """What pixels towards one offset contribute to distances: the sum of bins, and how many count."""

    total: Tensor
    number: Tensor

    def cut(self, top: int, height: Tensor | int, left: int, width: Tensor | int) -> _Terms:
        """Return a part."""
        part = (..., slice(top, top + height), slice(left, left + width))
        return _Terms(self.total[part], self.number[part])


_Place = tuple[int, int, int, int]
_Size = tuple[int, int]


class HistogramPatches:
    """Histograms of an image, padded by zeros, and the radius of the patch around each pixel."""

    def __init__(self, histogram: Tensor, kernel: HistogramKernel, fused: bool) -> None:
        self.kernel, self.fused = kernel, fused
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
        half = self.kernel.offsets[len(self.kernel.offsets) // 2 :]
        places = [self._place(offset, rows) for offset in half]
        found = self._fused(places) if self.fused else (self._terms(*place) for place in places)
        for (down, right), terms in zip(half, found, strict=True):
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

    def _place(self, offset: tuple[int, int], rows: tuple[int, int]) -> tuple[_Place, _Size]:
        """Return the first row and column, the offset, and the size of what patches of these rows need.

        Rows begin 2 F + down above, columns F and what the offset goes to the right before the first, so that
        the terms of the opposite offset are among them.
        """
        (start, stop), (down, right), patch = rows, offset, self.kernel.patch
        top, left = start - 2 * patch - down + self.pad, self.pad - patch - max(right, 0)
        size = (stop - start + 4 * patch + down, self.size[1] + 2 * patch + abs(right))
        return (top, left, down, right), size

    def _terms(self, place: _Place, size: _Size) -> _Terms:
        """Return the terms of a part of the image."""
        (top, left, down, right), (height, width) = place, size
        p = (..., slice(top, top + height), slice(left, left + width))
        q = (..., slice(top + down, top + down + height), slice(left + right, left + right + width))
        both = F.threshold(self.histogram[p] + self.histogram[q], LEAST, torch.inf, inplace=True)
        square = (self.share[p] - self.share[q]).square_()
        counts = self.number[p] * self.number[q]
        number = both.isfinite().sum(1, keepdim=True) * (counts > 0)
        return _Terms(square.div_(both).sum(1, keepdim=True) * counts, number.to(counts.dtype))

    def _fused(self, places: list[tuple[_Place, _Size]]) -> Iterator[_Terms]:
        """Return the terms of parts, from compiled loops."""
        from models.ops import fused

        rows = [
            fused.pixel_terms(
                (h.numpy(), share.numpy(), number[0].numpy()), places, LEAST, torch.get_num_threads()
            )
            for h, share, number in zip(self.histogram, self.share, self.number, strict=True)
        ]
        for parts in zip(*rows, strict=True):
            terms = torch.from_numpy(np.stack(parts))
            yield _Terms(terms[:, :1], terms[:, 1:])

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
