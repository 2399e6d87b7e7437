"""Outliers among similar neighbours, which become the mean of these.

Around pixel p, N are those of its 8 neighbours inside the image that are similar: squared distances of albedo
and of normal below 0.1. With l = 0.2989 R + 0.5870 G + 0.1140 B of the tone-mapped image,

    |l_p - mean of l over N| > 3 (standard deviation of l over N, divided by n - 1)

makes p an outlier, and its value the mean of the neighbours' linear values. Fewer than two neighbours tell
nothing.

Source: the outlier filter for 64 samples per pixel in the code of Meng et al. 2020
(doi:10.2312/sr.20201133), whose kernel also reads neighbours that were not accepted; not taken over.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.precision import wide
from models.ops.tonemap import filmic

GREY = (0.2989, 0.5870, 0.1140)
"""Weights of red, green and blue."""

SIMILAR = 0.1
"""Squared distances of albedo and normal below which neighbours count."""

SPREAD = 3.0
"""Standard deviations beyond which a pixel is an outlier."""


def replace_outliers(image: Tensor, albedo: Tensor, normal: Tensor, exposure: Tensor) -> Tensor:
    """Return the image with outliers replaced.

    Args:
        image: Linear radiance, (B, 3, H, W), at least 0.
        albedo: (B, 3, H, W).
        normal: Unit vectors (B, 3, H, W), or zeros.
        exposure: The image is multiplied by it before the tone curve, (B, 1, 1, 1) or (1, 1, 1, 1).

    Returns:
        (B, 3, H, W), float32 or wider.
    """
    image = wide(image)
    tone = filmic(image * exposure)
    grey = (tone * tone.new_tensor(GREY)[:, None, None]).sum(1, keepdim=True)
    features = torch.cat([albedo, normal, image, grey, torch.ones_like(image[:, :1])], 1)
    padded = F.pad(features, [1] * 4)
    count, mean_grey, mean = (torch.zeros_like(image[:, :n]) for n in (1, 1, 3))
    seen: list[tuple[Tensor, Tensor]] = []
    for index in (0, 1, 2, 3, 5, 6, 7, 8):
        near = _shifted(padded, *divmod(index, 3))
        similar = near[:, 10:] * _similar(near[:, :3], albedo) * _similar(near[:, 3:6], normal)
        seen.append((similar, near[:, 9:10]))
        count, mean_grey = count + similar, mean_grey + similar * near[:, 9:10]
        mean = mean + similar * near[:, 6:9]
    divisor = count.clamp_min(1.0)
    mean_grey, mean = mean_grey / divisor, mean / divisor
    squares = torch.stack([similar * (other - mean_grey).square() for similar, other in seen]).sum(0)
    variance = squares / (count - 1.0).clamp_min(1.0)
    far = (grey - mean_grey).square() > SPREAD**2 * variance
    return torch.where(far & (count > 1), mean, image)


def _shifted(padded: Tensor, down: int, right: int) -> Tensor:
    """Return the neighbours of all pixels in one direction; bounds count from the end, for graphs."""
    rows = padded[:, :, down : down - 2] if down < 2 else padded[:, :, down:]
    return rows[..., right : right - 2] if right < 2 else rows[..., right:]


def _similar(one: Tensor, other: Tensor) -> Tensor:
    return ((one - other).square().sum(1, keepdim=True) < SIMILAR).to(one.dtype)
