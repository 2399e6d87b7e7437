"""Kernel gather that counts only neighbours with light, divided by the weights that counted.

    out_c(p) = sum_q w_q(p) image_c(p + q) / (sum_q w_q(p) + 1e-8)

over those of the K x K offsets q, row by row, that stay inside the image and where image_c(p + q) > 0: which
neighbours count differs between channels. Weights are not negative, for example a ReLU. Where nothing counts,
or all weights that count are 0, the result is 0.

Source: the kernels of MR-KP in the code of Meng et al. 2020 (doi:10.2312/sr.20201133).

Both sums are linear in the weights: of the image where it is positive, and of 1 where it is. So they are
gathers of 2 C maps with the same kernels (`models.ops.gather_inside.gather_weighted`), and what is said there
of precision, derivatives and memory holds here: no unfolded image exists in either pass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from models.ops.gather_inside import gather_weighted
from models.ops.precision import wide

EPSILON = 1e-8
"""Added to the sums of weights."""


def gather_positive(image: Tensor, weights: Tensor, size: int) -> Tensor:
    """Return for every pixel and channel the weighted mean of the neighbours that are above 0.

    The gradient with respect to the image is 0 where it is not above 0.

    Args:
        image: (B, C, H, W).
        weights: (B, K * K, H, W), at least 0; map `K * (dy + r) + dx + r` weighs the pixel dy rows below and
            dx columns to the right.
        size: K, odd.

    Returns:
        (B, C, H, W), in float32, or float64 for float64 images.

    Raises:
        ValueError: K is even, there are not K * K weights, or sizes differ.
    """
    image = wide(image)
    counts = (image > 0).to(image.dtype)
    both = torch.cat([torch.relu(image), counts], 1)
    total, weight = gather_weighted(both, weights, size).chunk(2, 1)
    return total / (weight + EPSILON)
