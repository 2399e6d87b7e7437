"""Kernel gather in which the outside of the image has no part: kernels are cut at the border.

    out(p) = sum_q w_q(p) image(p + q),   q over those of the K x K offsets, row by row, that stay inside

Weights are given (`gather_weighted`), or the softmax of logits over the offsets that stay inside, so that
what is left of a kernel at the border sums to 1 (`gather_inside`): the rule of WSKP (Fan et al. 2021,
doi:10.1111/cgf.14338). `models.ops.gather` mirrors the image or gives its outside weight.

Everything runs in float32, or float64 for float64 images, also under mixed precision, is differentiable once
and keeps image and logits only: the backward pass computes weights again (`models.ops.kernel_blocks`). No
unfolded image exists in either pass, and memory beyond inputs, outputs and gradients does not grow with the
kernels.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops import kernel_graph as graph
from models.ops.boxes import exporting
from models.ops.kernel_blocks import Kernels, collect, scatter, slopes
from models.ops.precision import wide
from models.ops.splat import check_kernels


def gather_weighted(image: Tensor, weights: Tensor, size: int) -> Tensor:
    """Return for every pixel the sum of its neighbours with its own weights; outside the image is nothing.

    The adjoint of `models.ops.splat.splat`.

    Args:
        image: (B, C, H, W).
        weights: (B, K * K, H, W); map `K * (dy + r) + dx + r` weighs the pixel dy rows below and dx columns
            to the right.
        size: K, odd.

    Returns:
        (B, C, H, W), not divided by the weights.

    Raises:
        ValueError: K is even, there are not K * K weights, or sizes differ.
    """
    image, weights = wide(image)[:, None], weights[:, None]
    if exporting():
        return graph.collect(image, graph.weights(weights.to(image.dtype), size, None, None), size)[:, 0]
    check_kernels(image, weights, size)
    return _gathered(image, Kernels(weights, size, image.dtype))


def gather_inside(image: Tensor, logits: Tensor, size: int) -> Tensor:
    """Filter an image with kernels of which only the part inside the image counts.

    The softmax of each pixel runs over the offsets that stay in the image.

    Args:
        image: (B, C, H, W).
        logits: (B, K * K, H, W), in the order of `gather_weighted`.
        size: K, odd.

    Returns:
        (B, C, H, W).

    Raises:
        ValueError: As for `gather_weighted`.
    """
    image = wide(image)
    if not exporting():
        check_kernels(image[:, None], logits[:, None], size)
        return gather_inside_rows(image, logits, size, 0)
    both, numbers = torch.cat([image, torch.ones_like(image[:, :1])], 1), logits.to(image.dtype)
    largest, none = (
        graph.inside_maximum(logits.detach(), size).to(image.dtype),
        torch.zeros_like(image[:, :1]),
    )
    weights = graph.weights(numbers[:, None], size, largest[:, None], none)
    return _ratio(graph.collect(both[:, None], weights, size)[:, 0])


def gather_inside_rows(image: Tensor, logits: Tensor, size: int, first: int) -> Tensor:
    """Return some rows of what `gather_inside` makes, for whose pixels alone there are logits.

    Logits of a whole image are the largest tensor of a network that predicts kernels: where no gradient is
    wanted they need not exist at the same time. Not for recorded graphs.

    Args:
        image: (B, C, H, W), all of it.
        logits: (B, K * K, h, W) of rows `first` … `first + h - 1`.
        size: K, odd.
        first: Row of the image that the logits begin with.

    Returns:
        (B, C, h, W).
    """
    image, reach = wide(image), size // 2
    rows, height = logits.shape[-2], image.shape[-2]
    seen = image[..., max(0, first - reach) : first + rows + reach, :]
    missing = (max(0, reach - first), max(0, first + rows + reach - height))
    if rows == height:  # then all rows count as they are, without a padded copy
        missing = (0, 0)
    both = _extended(torch.cat([seen, torch.ones_like(seen[:, :1])], 1), missing, 0.0)
    # Beside the largest logit, weights are shifted by 0 where the image is and by infinity elsewhere.
    outside = _extended(torch.zeros_like(seen[:, :1]), missing, torch.inf)
    largest = _inside_maximum(logits.detach(), size, image.dtype, first, height)
    kernels = Kernels(logits[:, None], size, image.dtype, largest[:, None], outside)
    return _ratio(_gathered(both[:, None], kernels))


def _inside_maximum(logits: Tensor, size: int, dtype: torch.dtype, first: int, height: int) -> Tensor:
    """Return the largest logit of every pixel over the offsets that stay in the image, (B, 1, h, W)."""
    batch, _, rows, width = logits.shape
    reach = size // 2
    out = logits.new_full((batch, 1, rows, width), -torch.inf, dtype=dtype)
    for index in range(size * size):
        dy, dx = divmod(index, size)
        lines = slice(max(0, reach - dy - first), max(0, min(rows, height + reach - dy - first)))
        columns = slice(max(0, reach - dx), max(0, min(width, width + reach - dx)))
        part = out[:, 0, lines, columns]
        torch.maximum(part, logits[:, index, lines, columns].to(dtype), out=part)
    return out


def _extended(image: Tensor, rows: tuple[int, int], value: float) -> Tensor:
    """Return the image with so many rows more above and below."""
    return F.pad(image, (0, 0, *rows), value=value) if any(rows) else image


def _ratio(sums: Tensor) -> Tensor:
    return sums[:, :-1] / sums[:, -1:]


def _gathered(image: Tensor, kernels: Kernels) -> Tensor:
    """Return the sums (B, C, h, W) that kernels make of an image (B, 1, C, h or h + K - 1, W)."""
    if torch.is_grad_enabled() and (image.requires_grad or kernels.numbers.requires_grad):
        result: Tensor = _Gather.apply(image, kernels.numbers, kernels)
        return result[:, 0]
    return collect(kernels, image)[:, 0]


class _Gather(torch.autograd.Function):
    """`collect` with a backward pass that computes the weights again.

    dL/d(image) splats the incoming gradient g; dL/d(weight_q) = <g(p), image(p + q)>, times w_q for a logit.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, numbers: Tensor, kernels: Kernels) -> Tensor:
        ctx.save_for_backward(image, numbers, kernels.source, kernels.target)
        ctx.size = kernels.size
        return collect(kernels, image)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        image, numbers, source, target = ctx.saved_tensors
        kernels = Kernels(numbers, ctx.size, image.dtype, source, target)
        for_image, for_numbers = ctx.needs_input_grad[:2]
        beyond = image.shape[-2] > numbers.shape[-2]
        d_image = scatter(kernels, gradient, beyond)[:, None, :-1] if for_image else None
        d_numbers = slopes(kernels, gradient, image, (False, for_numbers, False)).numbers
        return d_image, d_numbers, None
