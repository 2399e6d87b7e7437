"""Images in halved resolutions, and their way back: what multi-resolution kernel prediction filters.

    o = f - alpha U(D f) + alpha U(c)

D is the mean of 2x2 pixels, U doubles the sides, f is the filtered fine image and c the result of the next
coarser resolution: equation 7 of Fan et al. 2021 (doi:10.1111/cgf.14338), after Vogels et al. 2018
(doi:10.1145/3197517.3201388). U repeats every pixel, or interpolates as the code of Meng et al. 2020
(doi:10.2312/sr.20201133) does. With repeated pixels and alpha 1 the mean of every 2x2 pixels is that of the
coarse result; with alpha 0 the fine image stays. The result can be below 0 where a dark pixel has bright
neighbours.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.precision import wide

Upsampling = Literal["nearest", "linear"]
"""Every pixel four times, or `doubled`."""


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


def doubled(image: Tensor) -> Tensor:
    """Return an image of twice the size; pixels of even row and column are those of the image.

    Odd ones are the mean of the two pixels beside them, or of the four around them; pixels outside of the
    image do not count, so the last row and column are repeated. Against pixel centres the result is shifted
    by half a pixel. The upsampling of MR-KP in the code of Meng et al. 2020.

    Args:
        image: (B, C, H, W).

    Returns:
        (B, C, 2 H, 2 W).
    """
    image = F.pad(image, (0, 1, 0, 1), mode="replicate")
    above, below = image[:, :, :-1], image[:, :, 1:]
    rows = torch.stack([above, 0.5 * (above + below)], 3).flatten(2, 3)
    left, right = rows[..., :-1], rows[..., 1:]
    return torch.stack([left, 0.5 * (left + right)], 4).flatten(3, 4)


def blended(fine: Tensor, coarse: Tensor, alpha: Tensor, upsampling: Upsampling = "nearest") -> Tensor:
    """Return `fine - alpha U(D fine) + alpha U(coarse)`, in float32 or wider.

    Args:
        fine: (B, C, H, W), H and W even.
        coarse: (B, C, H / 2, W / 2).
        alpha: (B, 1, H, W), in [0, 1]; MR-KP of Meng et al. has it also above 1.
        upsampling: U.
    """
    fine, coarse = wide(fine), wide(coarse)
    change = coarse - F.avg_pool2d(fine, 2)
    if upsampling == "linear":
        return fine + wide(alpha) * doubled(change)
    return fine + wide(alpha) * F.interpolate(change, scale_factor=2, mode="nearest")
