"""Images in halved resolutions, and their way back: what multi-resolution kernel prediction filters.

    o = f - alpha U(D f) + alpha U(c)

D is the mean of 2x2 pixels, U repeats every pixel, f is the filtered fine image and c the result of the next
coarser resolution: equation 7 of Fan et al. 2021 (doi:10.1111/cgf.14338), after Vogels et al. 2018
(doi:10.1145/3197517.3201388). With alpha 1 the mean of every 2x2 pixels is that of the coarse result, with
alpha 0 the fine image stays. The result can be below 0 where a dark pixel has bright neighbours.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from models.ops.precision import wide


def resolutions(image: Tensor, count: int) -> list[Tensor]:
    """Return an image (B, C, H, W), and its means over 2x2 pixels, over 4x4 …, `count` images in all.

    Args:
        image: Sides are multiples of 2**(count - 1).
        count: At least 1.
    """
    images = [wide(image)]
    while len(images) < count:
        images.append(F.avg_pool2d(images[-1], 2))
    return images


def blended(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """Return `fine - alpha U(D fine) + alpha U(coarse)`, in float32 or wider.

    Args:
        fine: (B, C, H, W), H and W even.
        coarse: (B, C, H / 2, W / 2).
        alpha: (B, 1, H, W), in [0, 1].
    """
    fine, coarse = wide(fine), wide(coarse)
    change = F.interpolate(coarse - F.avg_pool2d(fine, 2), scale_factor=2, mode="nearest")
    return fine + wide(alpha) * change
