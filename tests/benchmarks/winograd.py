"""Winograd's 3x3 convolution as matrix products, for the search of `afgsa_search`.

    Y = A^T [(G g G^T) * (B^T d B)] A        Lavin and Gray 2016, doi:10.1109/CVPR.2016.435, section 4

over tiles d of m + 2 pixels, summed over channels: one matrix product per entry of a tile, of 36 / 16 or
16 / 4 of the image's size.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_B = {
    2: [[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, 1, 0, -1]],
    4: [[4, 0, -5, 0, 1, 0], [0, -4, -4, 1, 1, 0], [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0], [0, 2, -1, -2, 1, 0], [0, 4, 0, -5, 0, 1]],
}  # fmt: skip
_G = {
    2: [[1, 0, 0], [1 / 2, 1 / 2, 1 / 2], [1 / 2, -1 / 2, 1 / 2], [0, 0, 1]],
    4: [[1 / 4, 0, 0], [-1 / 6, -1 / 6, -1 / 6], [-1 / 6, 1 / 6, -1 / 6],
        [1 / 24, 1 / 12, 1 / 6], [1 / 24, -1 / 12, 1 / 6], [0, 0, 1]],
}  # fmt: skip
_A = {
    2: [[1, 1, 1, 0], [0, 1, -1, -1]],
    4: [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]],
}


def winograd(image: Tensor, weight: Tensor, m: int) -> Callable[[], Tensor]:
    """Return the convolution of an image (1, C, H + 2, W + 2), channels innermost, with (D, C, 3, 3).

    The weights are transformed beforehand. H and W divide by m, the side of an output tile, 2 or 4.
    """
    side, (height, width) = m + 2, (size - 2 for size in image.shape[-2:])
    b, g, a = (torch.tensor(table[m], dtype=torch.float64) for table in (_B, _G, _A))
    kernels = torch.einsum("ia,jb,dcab->ijcd", g, g, weight.double()).flatten(0, 1).float().contiguous()
    inner, outer = torch.kron(b, b).float(), torch.kron(a, a).float()
    pixels = image[0].permute(1, 2, 0)
    strides = pixels.stride()
    shape = (side, side, height // m, width // m, pixels.shape[2])
    steps = (strides[0], strides[1], m * strides[0], m * strides[1], strides[2])

    def call() -> Tensor:
        tiles = pixels.as_strided(shape, steps).reshape(side * side, -1)
        products = torch.bmm((inner @ tiles).view(side * side, -1, shape[-1]), kernels)
        results = (outer @ products.flatten(1)).view(m, m, height // m, width // m, -1)
        return results.permute(2, 0, 3, 1, 4).reshape(1, height, width, -1).permute(0, 3, 1, 2)

    return call
