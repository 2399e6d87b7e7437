"""A cross-bilateral filter whose distances every pixel scales by numbers of its own.

Nima Khademi Kalantari, Steve Bako, Pradeep Sen: "A Machine Learning Approach for Filtering Monte Carlo
Noise", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766977, released code. With the colour c of
variance V, groups k of features f of variance v, and the numbers a of pixel p,

    D_0 = |q - p|^2,   D_k = sum over channels of (f_p - f_q)^2 / max(least, v_p)
    w(p, q) = exp(-[a_0 D_0 + factor * sum over channels of (c_p - c_q)^2 / (epsilon + V_p + V_q)
                    + sum over k of a_k D_k])
    F_p = sum of w c_q / sum of w.

a is positive, so that no exponent is above 0, and the pixel itself weighs 1: nothing over- or underflows.
Neighbours outside the image are skipped. The derivative of the result follows from sums of the same pass,

    dF / da_k = -(sum of w D_k c_q - F sum of w D_k) / sum of w,

so that training keeps 3 numbers for each a and nothing that grows with the window. What is added up is
c_q - c_p: constants then stay what they are, and sums are rounded as differences are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import exporting
from models.ops.nlm import strips, use_fused
from models.pace import tick

_FARTHEST = 1e30
"""Distances stay below it, so that their products with weights of 0 are 0; it is no part of the method."""


class Pixels(NamedTuple):
    """What weights are made from.

    Attributes:
        color: (B, 3, H, W).
        variance: Of the colour, (B, 3, H, W).
        features: All channels of all groups, (B, K, H, W).
        spread: max(least, v), (B, K, H, W).
    """

    color: Tensor
    variance: Tensor
    features: Tensor
    spread: Tensor


@dataclass(frozen=True)
class BilateralRule:
    """How distances are made.

    Attributes:
        groups: Channels of each group.
        window: Radius of the window.
        factor: Of the colour's distance.
        epsilon: Added to its denominator.
    """

    groups: tuple[int, ...]
    window: int = 27
    factor: float = 0.01
    epsilon: float = 1e-10

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.window < 1 or not self.factor >= 0 or not self.epsilon > 0:
            raise ValueError(
                "a cross-bilateral filter needs a window radius >= 1, a factor >= 0 and an epsilon > 0, got "
                f"{self.window}, {self.factor} and {self.epsilon}"
            )

    @property
    def distances(self) -> int:
        """Number of distances that are scaled."""
        return 1 + len(self.groups)


def scaled_bilateral(
    pixels: Pixels,
    scales: Tensor,
    rule: BilateralRule,
    budget: float | None = None,
    *,
    fused: bool | None = None,
) -> Tensor:
    """Return the filtered colour, (B, 3, H, W).

    Memory does not grow with the window, gradients of the scales included; where a gradient of the pixels
    is asked for, everything is kept for it.

    Args:
        pixels: What weights are made from, and what is filtered.
        scales: a, (B, 1 + groups, H, W), at least 0.
        rule: How distances are made.
        budget: Working memory in bytes, which sets the height of strips; see `models.ops.nlm.strips`.
        fused: See `models.ops.nlm.use_fused`.
    """
    if exporting() or (torch.is_grad_enabled() and any(part.requires_grad for part in pixels)):
        return _summed(pixels, scales, rule, budget, slopes=False).color
    color: Tensor = _Filter.apply(scales, *pixels, rule, budget, fused)
    return color


class Filtered(NamedTuple):
    """What one pass gives.

    Attributes:
        color: (B, 3, H, W).
        slopes: dF / da, (B, 1 + groups, 3, H, W), or None where it is not asked for.
    """

    color: Tensor
    slopes: Tensor | None


class _Filter(torch.autograd.Function):
    """The filter with the gradient of the scales."""

    @staticmethod
    def forward(
        ctx: Any,
        scales: Tensor,
        color: Tensor,
        variance: Tensor,
        features: Tensor,
        spread: Tensor,
        rule: BilateralRule,
        budget: float | None,
        fused: bool | None,
    ) -> Tensor:
        pixels, wanted = Pixels(color, variance, features, spread), bool(ctx.needs_input_grad[0])
        if use_fused(fused, scales, *pixels):
            found = _summed_fused(pixels, scales, rule, wanted)
        else:
            found = _summed(pixels, scales, rule, budget, wanted)
        if found.slopes is not None:
            ctx.save_for_backward(found.slopes)
        return found.color

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return ((slopes * gradient[:, None]).sum(2), *[None] * 7)


def _summed(
    pixels: Pixels, scales: Tensor, rule: BilateralRule, budget: float | None, slopes: bool
) -> Filtered:
    """Filter strip by strip, one offset after the other."""
    height, width = scales.shape[-2:]
    window = rule.window
    padded = F.pad(torch.cat(pixels[:3], 1), [window] * 4)
    planes = 4 * padded.shape[1] + (8 + 6 * slopes) * rule.distances
    row_bytes = scales.element_size() * scales.shape[0] * width * planes
    found = []
    for start, stop in [(0, height)] if exporting() else strips(height, row_bytes, budget, scales.device):
        strip = _Strip(pixels, scales, rule, (start, stop))
        for down in range(-window, window + 1):
            for right in range(-window, window + 1):
                strip.add(padded, (down, right), slopes)
            tick((2 * window + 1) * (stop - start) / height)
        found.append(strip.result(slopes))
    color = torch.cat([part.color for part in found], -2)
    each = [part.slopes for part in found if part.slopes is not None]
    return Filtered(color, torch.cat(each, -2) if each else None)


class _Strip:
    """Sums over the neighbours of some rows."""

    def __init__(self, pixels: Pixels, scales: Tensor, rule: BilateralRule, rows: tuple[int, int]) -> None:
        self.rule, self.rows, self.size = rule, rows, scales.shape[-2:]
        part = (..., slice(*rows), slice(None))
        self.color, self.variance, self.features, self.spread = (x[part] for x in pixels)
        self.scales = scales[part]
        self.norm = torch.zeros_like(self.scales[:, :1])
        self.total = torch.zeros_like(self.color)
        self.moments: Tensor | float = 0.0
        self.products: Tensor | float = 0.0

    def add(self, padded: Tensor, offset: tuple[int, int], slopes: bool) -> None:
        """Add the neighbours at one offset."""
        (down, right), (start, stop), window = offset, self.rows, self.rule.window
        top, left = window + down + start, window + right
        there = padded[..., top : top + stop - start, left : left + self.size[1]]
        color, variance, features = there.split([3, 3, self.features.shape[1]], 1)
        difference = color - self.color
        d = self._distances(features, float(down * down + right * right))
        of_color = difference.square() / (self.rule.epsilon + self.variance + variance)
        near = of_color.sum(1, keepdim=True).clamp_max(_FARTHEST)
        exponent = self.rule.factor * near + (self.scales * d).sum(1, keepdim=True)
        weight = torch.exp(-exponent) * self._inside(offset)
        self.norm = self.norm + weight
        self.total = self.total + weight * difference
        if slopes:
            weighted = weight * d
            self.moments = self.moments + weighted[:, :, None]
            self.products = self.products + weighted[:, :, None] * difference[:, None]

    def result(self, slopes: bool) -> Filtered:
        """Return the filtered colour, and its derivative where it is asked for."""
        change = self.total / self.norm
        if not slopes:
            return Filtered(self.color + change, None)
        products = self.products - change[:, None] * self.moments
        return Filtered(self.color + change, -products / self.norm[:, :, None])

    def _distances(self, features: Tensor, place: float) -> Tensor:
        """Return the distances that are scaled, (B, 1 + groups, rows, W)."""
        each = (self.features - features).square() / self.spread
        parts = [torch.full_like(self.norm, place)]
        parts += [group.sum(1, keepdim=True) for group in each.split(list(self.rule.groups), 1)]
        return torch.cat(parts, 1).clamp_max(_FARTHEST)

    def _inside(self, offset: tuple[int, int]) -> Tensor:
        """Return 1 where the neighbour is inside the image, 0 elsewhere."""
        (down, right), (start, stop), (height, width) = offset, self.rows, self.size
        like = self.scales
        rows, columns = (
            torch.arange(first, last, device=like.device) + step
            for first, last, step in ((start, stop, down), (0, width, right))
        )
        inside = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
        return inside.to(like.dtype)


def _summed_fused(pixels: Pixels, scales: Tensor, rule: BilateralRule, slopes: bool) -> Filtered:
    from models.ops import fused

    threads = torch.get_num_threads()
    images = [[x.numpy() for x in image] for image in zip(scales, *pixels, strict=True)]
    found = [fused.filter_scaled(parts, own, rule, slopes, threads) for own, *parts in images]
    color = torch.from_numpy(np.stack([image for image, _ in found]))
    each = [slope for _, slope in found if slope is not None]
    return Filtered(color, torch.from_numpy(np.stack(each)) if each else None)
