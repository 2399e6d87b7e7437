"""Box sums: the sum over a square window around every pixel, separable, without integral images."""

from __future__ import annotations

from collections.abc import Sequence

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


def box_sums_exported(stacks: Sequence[Tensor], sizes: Sequence[int], channels: int) -> list[Tensor]:
    """Sum a window of its own size in every stack, in the form that runs fast in an exported graph.

    TorchScript runs the additions of `box_sum`. In a graph for ONNX they would be a hundred slices; there
    all stacks go through two depthwise convolutions with rows and columns of ones, which ONNX Runtime
    executes ten times faster than average poolings.

    Args:
        stacks: Tensors (B, C, H, W), one for each size.
        sizes: Odd window sizes.
        channels: C; as a number, since the tensors' shapes are symbols there.
    """
    if torch.jit.is_tracing() and not torch.onnx.is_in_onnx_export():
        return [box_sum(stack, size) for stack, size in zip(stacks, sizes, strict=True)]
    reach = max(sizes) // 2
    margins = [reach - size // 2 for size in sizes]
    # Literal sizes, so that the kernels become constants of the graph.
    rows = torch.cat(
        [F.pad(torch.ones(channels, 1, 1, s), (m, m)) for s, m in zip(sizes, margins, strict=True)]
    ).to(stacks[0])
    joined, groups = torch.cat(list(stacks), 1), channels * len(sizes)
    wide = F.conv2d(joined, rows, padding=(0, reach), groups=groups)
    sums = F.conv2d(wide, rows.transpose(-1, -2), padding=(reach, 0), groups=groups)
    return list(sums.split(channels, 1))


def exporting() -> bool:
    """Whether the code runs under torch.jit.trace or torch.export, where Python branches on data are lost."""
    return torch.jit.is_tracing() or torch.compiler.is_exporting()
