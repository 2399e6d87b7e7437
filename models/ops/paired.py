"""Filtering with the weights of `models.ops.opposite`, and how much the result depends on its own pixel.

The derivative of the result by the pixel's own colour is what Stein's unbiased risk estimate needs: Fabrice
Rousselle, Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color Information", Computer
Graphics Forum 32(7), 2013, doi:10.1111/cgf.12219. As in its released code it is a difference: the filter runs
again with the pixel's colour times 1 + step, and the change of the result is divided by that of the pixel.
Of the patches around it only the centre changes, by (d' - d) / (2 F + 1)^2. Where a channel of the derivative
is not in [0, 1], and for weights that do not look at colour, all channels are w_p / sum of w.

What is added up are the changes of the weights themselves: the difference of two sums over hundreds of
neighbours would be rounded as the sums are, a hundred times as much as the change is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.nlm import Guide, strips
from models.ops.opposite import CENTRE, FeatureMap, PairKernel, Pairs, Pixels
from models.ops.symmetric import mirrored_border
from models.pace import tick


class Paired(NamedTuple):
    """Filtered images.

    Attributes:
        images: For each rule, (B, K, C, H, W).
        derivative: Of the last channels by the guide, (B, K, c, H, W), in [0, 1]; None: not asked for.
    """

    images: Tensor
    derivative: Tensor | None


def pair_filter(
    images: Tensor,
    guide: Guide,
    kernel: PairKernel,
    features: Sequence[FeatureMap] = (),
    budget: float | None = None,
    *,
    step: float = 0.0,
) -> Paired:
    """Filter images with the weights of a guide and of features.

    Args:
        images: (B, C, H, W); where `step` is not 0 the last channels are the guide's image.
        guide: What colour weights are made from, (B, c, H, W).
        kernel: How weights are made.
        features: What else weights look at.
        budget: Working memory in bytes, which sets the height of strips; see `models.ops.nlm.strips`.
        step: Relative change of the colour that gives the derivative, 0: no derivative.
    """
    window, margin = kernel.window, kernel.margin
    height, width = images.shape[-2:]
    pixels = _pixels(images, guide, kernel, features)
    sizes = [part.shape[1] for part in (*pixels[:-1], *pixels.t)]
    mirrored = torch.cat([*pixels[:-1], *pixels.t], 1)
    for axis in (-1, -2):
        mirrored = mirrored_border(mirrored, window, axis)
    groups = [feature.image.shape[1] for feature in features] if kernel.taus else []
    if exporting():
        return _filtered(Pairs(mirrored, sizes, groups, kernel, step), 1.0)
    planes = sum(sizes) + 10 * sum(groups) + 60 + (images.shape[1] + 12) * len(kernel.rules)
    found = []
    for start, stop in strips(height, 4 * images.shape[0] * width * planes, budget, images.device):
        top, bottom = max(0, start - margin), min(height, stop + margin)
        pairs = Pairs(mirrored[..., top : bottom + 2 * window, :], sizes, groups, kernel, step)
        core = slice(start - top, stop - top)
        found.append([x[..., core, :] for x in _filtered(pairs, (stop - start) / height) if x is not None])
    joined = [torch.cat(parts, -2) for parts in zip(*found, strict=True)]
    return Paired(joined[0], joined[1] if step else None)


def _pixels(images: Tensor, guide: Guide, kernel: PairKernel, features: Sequence[FeatureMap]) -> Pixels:
    used = features if kernel.taus else ()

    def side_by_side(parts: list[Tensor]) -> Tensor:
        return torch.cat(parts, 1) if parts else images[:, :0]

    return Pixels(
        torch.cat([images, torch.ones_like(images[:, :1])], 1),
        guide.image,
        guide.variance,
        side_by_side([feature.image for feature in used]),
        side_by_side([feature.variance for feature in used]),
        tuple(side_by_side([feature.spread(tau) for feature in used]) for tau in kernel.taus),
    )


def _filtered(pairs: Pairs, share: float) -> Paired:
    """Filter some rows; share: the part of the image that they are."""
    own, rules, step = pairs.own, pairs.kernel.rules, pairs.step
    batch, channels, height, width = own.images.shape
    total = own.images.new_zeros(batch, len(rules), channels, height, width)
    largest = total[:, :, :1] + CENTRE
    change = _Change(pairs, step) if step else None
    for down, right in pairs.offsets():
        sides = pairs.at(down, right), pairs.at(-down, -right)
        still, moved = pairs.weights(sides)
        for i, side in enumerate(sides):
            total.addcmul_(still[:, :, i, None], side.images[:, None])
        largest = torch.maximum(largest, still.amax(2)[:, :, None])
        if change is not None:
            change.add(sides, still.detach(), moved)
        tick(2 * share)
    total.addcmul_(largest, own.images[:, None])
    images = total[:, :, :-1] / total[:, :, -1:]
    if change is None:
        return Paired(images, None)
    return Paired(images, change.derivative(images.detach(), largest.detach(), total[:, :, -1:].detach()))


class _Change:
    """The change of sums of weighted colours, and of weights, when the pixel's own colour is larger.

    Args:
        pairs: The pixels.
        step: Relative change of the colour.
    """

    def __init__(self, pairs: Pairs, step: float) -> None:
        self.step, self.color = step, pairs.own.u.detach()
        self.channels = self.color.shape[1]
        self.moving = moving = sum(rule.patch is not None for rule in pairs.kernel.rules)
        batch, _, height, width = self.color.shape
        self.sums = self.color.new_zeros(batch, moving, self.channels + 1, height, width)
        self.largest = self.sums[:, :, :1] + CENTRE

    @torch.no_grad()
    def add(self, sides: tuple[Pixels, Pixels], still: Tensor, moved: Tensor | None) -> None:
        """Add two opposite neighbours."""
        if moved is None:
            return
        difference = moved - still[:, : moved.shape[1]]
        for i, side in enumerate(sides):
            self.sums.addcmul_(difference[:, :, i, None], side.images[:, None, -self.channels - 1 :])
        self.largest = torch.maximum(self.largest, moved.amax(2)[:, :, None])

    @torch.no_grad()
    def derivative(self, images: Tensor, largest: Tensor, norm: Tensor) -> Tensor:
        """Return the derivative from the filtered images, the pixels' own weights and the sums of weights."""
        share = largest / norm
        result = share.expand(-1, -1, self.channels, -1, -1)
        moving = self.moving
        if not moving:
            return result
        color, before = self.color[:, None], images[:, :moving, -self.channels :]
        larger = self.largest - largest[:, :moving]
        sums = self.sums[:, :, :-1] + larger * color + self.step * self.largest * color
        weights = self.sums[:, :, -1:] + larger
        found = (sums - before * weights) / (norm[:, :moving] + weights) / (self.step * color)
        valid = ((found >= 0) & (found <= 1)).all(2, keepdim=True)  # NaN is not
        return torch.cat([torch.where(valid, found, result[:, :moving]), result[:, moving:]], 1)
