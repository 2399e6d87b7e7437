"""Box sums: the sum over a square window around every pixel, separable, without integral images."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def box_sum(maps: Tensor, size: int) -> Tensor:
    """Sum a size x size window around every pixel; pixels outside the image count as 0.

    Args:
        maps: (B, C, H, W), floating point.
        size: Odd window size.

    Returns:
        (B, C, H, W). The operation is its own adjoint.
    """
    return box_sum_valid(F.pad(maps, [size // 2] * 4), size)


def box_sum_valid(maps: Tensor, size: int) -> Tensor:
    """Sum every size x size window that lies inside the image.

    Two 1-D sums, each by doubling: sums of 1, 2, 4, 8 … neighbours come from adding shifted copies, and the
    binary digits of `size` say which of them make up the window. That takes at most 2 log2(size) additions
    per pixel and direction (5 for 13), so running time hardly depends on the size. Only numbers of the
    window itself are ever added: for non-negative maps the relative error stays near eps whatever the
    dynamic range of the image, which an integral image, a difference of two large sums, cannot give.

    Args:
        maps: (B, C, H, W), floating point.
        size: Window size.

    Returns:
        (B, C, H - size + 1, W - size + 1).
    """
    return _sum_along(_sum_along(maps, size, -1), size, -2)


def _sum_along(maps: Tensor, size: int, dim: int) -> Tensor:
    length = maps.shape[dim] - size + 1
    run, width, offset = maps, 1, 0
    parts: list[Tensor] = []
    while True:
        if size & width:
            parts.append(run.narrow(dim, offset, length))
            offset += width
        if 2 * width > size:
            break
        rest = run.shape[dim] - width
        run = run.narrow(dim, 0, rest) + run.narrow(dim, width, rest)
        width *= 2
    if len(parts) == 1:
        return parts[0]
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


def box_mean_padded(maps: Tensor, size: int) -> Tensor:
    """Return `box_sum / size**2` through two 1-D average poolings: the form for exported graphs.

    Runtimes execute a pooling as one node; the slices of `box_sum` would become dozens.

    Args:
        maps: (B, C, H, W).
        size: Odd window size.
    """
    radius = size // 2
    rows = F.avg_pool2d(maps, (1, size), stride=1, padding=(0, radius))
    return F.avg_pool2d(rows, (size, 1), stride=1, padding=(radius, 0))


def exporting() -> bool:
    """Whether the code runs under torch.jit.trace or torch.export, where Python branches on data are lost."""
    return torch.jit.is_tracing() or torch.compiler.is_exporting()
