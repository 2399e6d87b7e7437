"""Spikes: pixels that lie far from the mean around them and become the median of 3x3 pixels.

With the mean m and the standard deviation s of a channel in a square window,

    |x_p - m| > limit * s

in any channel makes p a spike; each of its channels becomes the median of its 3x3 pixels. So the released
code of LBF treats the variance of its colour and its result: Nima Khademi Kalantari, Steve Bako, Pradeep Sen:
"A Machine Learning Approach for Filtering Monte Carlo Noise", ACM Transactions on Graphics 34(4), 2015,
doi:10.1145/2766977. What is decided here, since it is not known: the window holds the pixel itself and loses
what lies outside the image; s divides by the number of pixels; medians at the border see border pixels twice.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import box_sum
from models.ops.sorting import in_order


def without_spikes(image: Tensor, radius: int, limit: float) -> Tensor:
    """Return the image with spikes replaced.

    Args:
        image: (B, C, H, W), finite.
        radius: Of the window whose mean and deviation count.
        limit: Deviations beyond which a pixel is a spike.
    """
    # In float32 the difference of two sums would be rounding alone where values hardly differ.
    seen = image.detach().double()
    mean, deviation = mean_and_deviation(seen, radius)
    far = ((seen - mean).abs() > limit * deviation).any(1, keepdim=True)
    return torch.where(far, median(image), image)


def mean_and_deviation(image: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of the part of each box inside the image, each (B, C, H, W).

    Args:
        image: (B, C, H, W), float64.
        radius: Of the box.
    """
    size = 2 * radius + 1
    share = box_sum(torch.ones_like(image[:1, :1]), size).reciprocal()
    mean = box_sum(image, size) * share
    square = box_sum(image.square(), size) * share - mean.square()
    return mean, square.clamp_min(1e-40).sqrt()


def median(image: Tensor) -> Tensor:
    """Return the median of 3x3 pixels, (B, C, H, W)."""
    padded = F.pad(image, [1] * 4, mode="replicate")
    rows = [padded[..., i : i - 2 if i < 2 else None, :] for i in range(3)]
    near = [row[..., i : i - 2 if i < 2 else None] for row in rows for i in range(3)]
    return in_order(near)[4]
