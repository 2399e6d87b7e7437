"""Non-local means with opposite neighbours compared together: the released code of RKZ12.

Fabrice Rousselle, Claude Knaus, Matthias Zwicker: "Adaptive rendering with non-local means filtering", ACM
Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214. What its code does beyond `models.ops.nlm`:

- Beside the distances to q1 = p + delta and q2 = p - delta, a third one compares u_p with (u_q1 + u_q2) / 2;
  with m_i = min(v_p, v_qi) its numerator subtracts v_p + (m_1 + m_2) / 4 and its denominator has
  v_p + (v_q1 + v_q2) / 4. Of the weights w1, w2 and wS that follow, r = clamp(wS / (w1 + w2) - 1, 0, 1) is
  the share of wS: both become r wS + (1 - r) w_i. Gradients, which cancel in pairs, are thus averaged.
- Weights are averaged over the patch, so that neighbouring pixels get similar ones. At the left and right
  border that mean divides by the full width although part of it lies outside.
- Weights below 0.05 are dropped; the pixel's own weight is 1.
- Neighbours outside the image are mirrored, -1 being pixel 0; patches lose what lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import box_sum_valid, exporting
from models.ops.nlm import Guide, PatchKernel, strips
from models.pace import tick

_TINY = 1e-38
_BLUR = 0.8
"""Sigma of the Gaussian that smooths the residual error."""


@dataclass(frozen=True)
class SymmetricKernel:
    """What happens to the weights.

    Attributes:
        patches: How patches are compared; one bandwidth, one weight from the mean of the channels' d.
        symmetric: Whether opposite neighbours are compared together.
        smoothing: Radius of the box that averages weights, 0: none.
        least: Smaller weights are dropped.
    """

    patches: PatchKernel
    symmetric: bool = True
    smoothing: int = 3
    least: float = 0.05

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.smoothing < 0:
            raise ValueError(f"the radius that smooths weights must be at least 0, got {self.smoothing}")
        if not 0 <= self.least < 1:
            raise ValueError(f"the least weight that counts must be in [0, 1), got {self.least}")

    @property
    def reach(self) -> int:
        """How far a weight looks from its pixel."""
        return self.patches.reach + self.smoothing


def symmetric_filter(
    image: Tensor, guide: Guide, kernel: SymmetricKernel, budget: float | None = None
) -> Tensor:
    """Filter an image (B, C, H, W) with the weights of a guide of the same shape.

    Args:
        image: What is filtered.
        guide: What weights are made from; `kernel.patches.scale` multiplies its variance.
        kernel: How weights are made.
        budget: Working memory in bytes, which sets the height of strips; see `models.ops.nlm.strips`.
    """
    window = kernel.patches.window
    height, width = image.shape[-2:]
    joined = torch.cat([image, guide.image, guide.variance * kernel.patches.scale], 1)
    mirrored = mirrored_border(mirrored_border(joined, window, -1), window, -2)
    margin = kernel.patches.patch + kernel.smoothing  # strips end in it as images do, and are cut to the core
    row_bytes = image.element_size() * image.shape[0] * width * 90
    if exporting():
        return _filter(mirrored, kernel)
    results = []
    for start, stop in strips(height, row_bytes, budget, image.device):
        top, bottom = max(0, start - margin), min(height, stop + margin)
        strip = _filter(mirrored[..., top : bottom + 2 * window, :], kernel, (stop - start) / height)
        results.append(strip[..., start - top : stop - top, :])
    return torch.cat(results, -2)


def _filter(mirrored: Tensor, kernel: SymmetricKernel, share: float = 1.0) -> Tensor:
    """Filter rows whose neighbours are all there; share: the part of the image that they are."""
    window = kernel.patches.window
    height, width = (size - 2 * window for size in mirrored.shape[-2:])

    def at(down: int, right: int) -> tuple[Tensor, ...]:
        rows = slice(window + down, window + down + height)
        return mirrored[..., rows, window + right : window + right + width].chunk(3, 1)

    own, u, v = at(0, 0)
    boxes = Boxes(u)
    total, norm = own, torch.ones_like(own[:, :1])
    for down in range(window + 1):
        for right in range(-window if down else 1, window + 1):
            sides = at(down, right), at(-down, -right)
            distances = _distances((u, v), [side[1:] for side in sides], kernel)
            weights = torch.exp(-boxes.mean(distances, kernel.patches.patch).clamp_min(0.0))
            weights = boxes.smoothed(_blended(weights), kernel.smoothing)
            weights = torch.where(weights < kernel.least, 0.0, weights)
            for side, weight in zip(sides, weights.chunk(2, 1), strict=True):
                total, norm = total + weight * side[0], norm + weight
            tick(2 * share)
    return total / norm


def _distances(
    own: tuple[Tensor, Tensor], sides: list[tuple[Tensor, ...]], kernel: SymmetricKernel
) -> Tensor:
    """Return d towards both neighbours and, if asked for, towards their mean: (B, 2 or 3, H, W)."""
    (u, v), ((u1, v1), (u2, v2)) = own, sides
    least1, least2 = torch.minimum(v, v1), torch.minimum(v, v2)
    terms = [((u - u1).square() - (v + least1), v + v1), ((u - u2).square() - (v + least2), v + v2)]
    if kernel.symmetric:
        square = (u - 0.5 * (u1 + u2)).square()
        terms.append((square - (v + 0.25 * (least1 + least2)), v + 0.25 * (v1 + v2)))
    (k,), epsilon, cap = kernel.patches.bandwidths, kernel.patches.epsilon, kernel.patches.cap
    d = torch.cat([(n / (k * k * s + epsilon)).mean(1, keepdim=True) for n, s in terms], 1)
    return torch.where(d < cap, d, cap)  # not a number becomes the cap


def _blended(weights: Tensor) -> Tensor:
    """Return the weights of both neighbours; weights: of both and of their mean."""
    if weights.shape[1] == 2:
        return weights
    both, mean = weights[:, :2], weights[:, 2:]
    share = (mean / both.sum(1, keepdim=True).clamp_min(_TINY) - 1).clamp(0.0, 1.0)
    return share * mean + (1 - share) * both


class Boxes:
    """Means over boxes that shrink at the border."""

    def __init__(self, like: Tensor) -> None:
        self.inside = torch.ones_like(like[:1, :1])
        self.counts: dict[int, Tensor] = {}

    def mean(self, maps: Tensor, radius: int) -> Tensor:
        """Average what lies inside the image."""
        if radius not in self.counts:
            self.counts[radius] = self._sum(self.inside, radius).reciprocal()
        return self._sum(maps, radius) * self.counts[radius]

    def smoothed(self, maps: Tensor, radius: int) -> Tensor:
        """Average, but divide by the full width at the left and right border."""
        if radius == 0:
            return maps
        rows = F.pad(self.inside[..., :1], (0, 0, radius, radius))
        count = rows.unfold(-2, 2 * radius + 1, 1).sum(-1)
        return self._sum(maps, radius) / (count * (2 * radius + 1))

    def _sum(self, maps: Tensor, radius: int) -> Tensor:
        return box_sum_valid(F.pad(maps, [radius] * 4), 2 * radius + 1)


def mirrored_border(image: Tensor, pad: int, axis: int) -> Tensor:
    """Repeat an image mirrored at both ends of an axis, as often as the pad takes."""
    size = image.shape[axis]
    places = torch.arange(-pad, size + pad, device=image.device) % (2 * size)
    return image.index_select(axis, torch.where(places < size, places, 2 * size - 1 - places))


def scaled_variance(variance: Tensor, a: Tensor, b: Tensor, radius: int = 10) -> Tensor:
    """Correct the variance of low-discrepancy samples, which their own variance overestimates.

    V box((a - b)^2 / 4) / (1e-10 + box(V)): the halves say how large the variance is, the samples where.
    Fabrice Rousselle, Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color Information",
    Computer Graphics Forum 32(7), 2013, doi:10.1111/cgf.12219, released code. RKZ12's own rule needs the
    sample variance of each half.

    Args:
        variance: Of the mean, from all samples, (B, C, H, W).
        a: Half A.
        b: Half B.
        radius: Of the box.
    """
    boxes = Boxes(variance)
    return variance * boxes.mean(0.25 * (a - b).square(), radius) / (1e-10 + boxes.mean(variance, radius))


def residual_error(a: Tensor, b: Tensor) -> Tensor:
    """Estimate the relative squared error of the mean of two filtered halves, times the samples per pixel.

    RKZ12, for adaptive sampling: 2 (a - b)^2 / (1e-3 + a^2), the mean of the channels, smoothed by a Gaussian
    of sigma 0.8 cut at 3 pixels, of which only the part inside the image counts. Divide by the number of
    samples per pixel (of the filtered image) to say where another sample helps most.

    Args:
        a: Filtered half, (B, C, H, W).
        b: The other one.

    Returns:
        (B, 1, H, W).
    """
    error = (2 * (a - b).square() / (1e-3 + a.square())).mean(1, keepdim=True)
    joined = torch.cat([error, torch.ones_like(error)], 1)
    for axis, pad in ((-1, (3, 3, 0, 0)), (-2, (0, 0, 3, 3))):
        steps = torch.arange(-3, 4, device=error.device).to(error.dtype)
        taps = torch.exp(-steps.square() / (2 * _BLUR**2))
        joined = (F.pad(joined, pad).unfold(axis, 7, 1) * taps).sum(-1)
    return joined[:, :1] / joined[:, 1:]
