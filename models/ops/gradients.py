"""Image gradients as network features."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def backward_differences(maps: Tensor) -> Tensor:
    """Return the difference of every pixel to its left and to its upper neighbour.

    Args:
        maps: (B, C, H, W).

    Returns:
        (B, 2 C, H, W): first x for all channels, `maps[x] - maps[x - 1]`, then y. The first column of the x
        differences and the first row of the y differences, which have no such neighbour, are 0.

    Source: the features of KPCN (Bako et al. 2017, doi:10.1145/3072959.3073708) in the form of SBMC's code.
    """
    across = F.pad(maps[..., :, 1:] - maps[..., :, :-1], (1, 0, 0, 0))
    down = F.pad(maps[..., 1:, :] - maps[..., :-1, :], (0, 0, 1, 0))
    return torch.cat([across, down], 1)
