"""Images padded to a method's own grid."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import exporting


def padded(images: Tensor, multiple: int, repeat: bool = True) -> Tensor:
    """Return images (…, H, W) with rows below and columns to the right up to multiples of a number.

    Recorded graphs hold the padding whatever the example's size.

    Args:
        images: With `repeat` (B, C, H, W).
        multiple: The number; at 1 the images come back as they are.
        repeat: Repeat the last row and column; otherwise zeros.
    """
    bottom, right = (-side % multiple for side in images.shape[-2:])
    if multiple == 1 or not (exporting() or bottom or right):
        return images
    return F.pad(images, (0, right, 0, bottom), mode="replicate" if repeat else "constant")
