"""Estimated errors of filtered images, and which of several images has the least.

Stein's unbiased risk estimate of a filter F of a noisy image C of variance V is, per channel,

    SURE = (F - C)^2 + 2 V dF/dC - V:

it needs no reference and no second image, only how much a pixel's result depends on that pixel itself. Used
as in Fabrice Rousselle, Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color
Information", Computer Graphics Forum 32(7), 2013, doi:10.1111/cgf.12219.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.nlm import Guide


def estimated_risk(images: Tensor, noisy: Guide, derivative: Tensor) -> Tensor:
    """Return SURE, the mean of the channels, (B, K, H, W); it may be negative.

    Args:
        images: K filtered images, (B, K, C, H, W).
        noisy: What was filtered and its variance, (B, C, H, W).
        derivative: Of each pixel by itself, (B, K, C, H, W).
    """
    variance = noisy.variance[:, None]
    square = (images - noisy.image[:, None]).square()
    return (square + 2 * variance * derivative - variance).mean(2)


def chosen_maps(errors: Tensor, derivatives: Tensor | None) -> Tensor:
    """Return which candidate has the least error as three maps of 0 and 1; of equal ones the later has it.

    Args:
        errors: (B, 3, H, W).
        derivatives: (B, 3, H, W): FIRST takes no part where its own is larger than SECOND's; None: it does.
    """
    first, second, third = errors.unbind(1)
    if derivatives is not None:
        first = torch.where(derivatives[:, 0] > derivatives[:, 1], torch.inf, first)
    is_third = third <= torch.minimum(first, second)
    is_second = ~is_third & (second <= first)
    return torch.stack([~is_third & ~is_second, is_second, is_third], 1).to(errors.dtype)


def blurred(image: Tensor) -> Tensor:
    """Return an image (B, C, H, W) blurred by 3x3 taps of a Gaussian of sigma 0.5, as far as it reaches."""
    side = math.exp(-2.0)

    def along(maps: Tensor, axis: int) -> Tensor:
        padding = (1, 1, 0, 0) if axis == -1 else (0, 0, 1, 1)
        before, here, after = F.pad(maps, padding).unfold(axis, 3, 1).unbind(-1)
        return here + side * (before + after)

    inside = torch.ones_like(image[:1, :1])
    return along(along(image, -1), -2) / along(along(inside, -1), -2)
