"""Statistics of features around each pixel, from which LBF's network predicts how to filter.

Nima Khademi Kalantari, Steve Bako, Pradeep Sen: "A Machine Learning Approach for Filtering Monte Carlo
Noise", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766977. Of every group of channels, filtered to
f with the residual variance v, unfiltered u:

    noise      the median of |Haar diagonals| of u in a block of 8x8 pixels, divided by 0.6745; averaged over
               2x2 pixels and dilated by 3x3
    mean       f, and its mean over 7x7 pixels
    deviation  the root of v, and the standard deviation of f over 7x7 pixels
    spread     the mean of |f_q - m| over 3x3 pixels, m being the mean of f there
    gradient   the squared gradient of f in 3x3 pixels (`models.ops.joint.squared_gradient`)

each the mean of the group's channels: 7 numbers. The sheet of facts that this follows leaves open how blocks
lie; decided here is what moves with the image: every pixel has a block, from 4 above and left of it to 3
below and right, of which 16 diagonals (a - b - c + d) / 2 of 2x2 pixels are taken; the mean over the pixel
and those below and right of it brings them back to its centre. Beyond the border images are mirrored for
blocks, and other windows lose what lies outside.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import box_sum
from models.ops.joint import squared_gradient
from models.ops.nlm import Guide
from models.ops.sorting import in_order
from models.ops.spikes import mean_and_deviation
from models.ops.symmetric import mirrored_border

NUMBERS = 7
"""Statistics of a group."""

WINDOW = 3
"""Radius of the windows on what is filtered."""

REACH = 5
"""Pixels that statistics look at on each side: blocks 4, their dilation one more."""

NORMAL = 0.6745
"""Median of the absolute value of a standard normal number."""

_BLOCK = 4
"""Half the side of a block."""


def secondary_features(filtered: Sequence[Guide], unfiltered: Sequence[Tensor]) -> Tensor:
    """Return the statistics of groups, (B, 7 groups, H, W), group by group in the order of the module.

    Args:
        filtered: Filtered groups and their residual variances, (B, C, H, W) each.
        unfiltered: The same before filtering.
    """
    parts = []
    for (image, variance), given in zip(filtered, unfiltered, strict=True):
        mean, deviation = mean_and_deviation(image.double(), 3)
        each = (
            noise(given),
            image,
            # Its slope at 0 would be infinite.
            variance.clamp_min(1e-30).sqrt(),
            mean.to(image.dtype),
            deviation.to(image.dtype),
            spread(image),
            squared_gradient(image),
        )
        parts += [x.mean(1, keepdim=True) for x in each]
    return torch.cat(parts, 1)


def noise(image: Tensor) -> Tensor:
    """Estimate the standard deviation of an image's noise around every pixel, (B, C, H, W)."""
    padded = mirrored_border(mirrored_border(image, _BLOCK, -2), _BLOCK, -1)
    # Channel by channel: 16 diagonals of all at once would be a lot.
    medians = torch.cat([_block_medians(channel) for channel in padded.split(1, 1)], 1)
    return F.max_pool2d(F.avg_pool2d(medians / NORMAL, 2, 1), 3, 1, 1)


def _block_medians(padded: Tensor) -> Tensor:
    """Return the median of the diagonals of the block around every place that has one."""
    across = padded[..., 1:] - padded[..., :-1]
    diagonal = (0.5 * (across[..., 1:, :] - across[..., :-1, :])).abs()
    last = 2 * (_BLOCK - 1)
    rows = [diagonal[..., i : i - last if i < last else None, :] for i in range(0, last + 1, 2)]
    block = [row[..., i : i - last if i < last else None] for row in rows for i in range(0, last + 1, 2)]
    ordered = in_order(block)
    middle = len(block) // 2
    return 0.5 * (ordered[middle - 1] + ordered[middle])


def spread(image: Tensor) -> Tensor:
    """Return the mean absolute deviation from the mean of 3x3 pixels, (B, C, H, W)."""
    inside = torch.ones_like(image[:1, :1])
    share = box_sum(inside, 3).reciprocal()
    mean = box_sum(image, 3) * share
    padded, within = F.pad(image, [1] * 4), F.pad(inside, [1] * 4)
    total = torch.zeros_like(image)
    for down in range(3):
        for right in range(3):
            place = (
                ...,
                slice(down, down - 2 if down < 2 else None),
                slice(right, right - 2 if right < 2 else None),
            )
            total = total + within[place] * (padded[place] - mean).abs()
    return total * share
