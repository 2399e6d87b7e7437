"""Kernel splat: every pixel of every sample or layer spreads its value over its neighbours.

    total(p + q) += w_q(n, p) values(n, p),      weight(p + q) += w_q(n, p),      over images n and pixels p

with q over the K x K offsets, row by row; offsets that leave the image are dropped. The result is
total / (weight + eps), with what a paper adds.

Weights are predicted, exp(logit - shift). Two rules exist for the shift, and they are not the same filter.
Munkberg and Hasselgren 2020 (doi:10.1111/cgf.14049) subtract the largest logit of the pixel that splats:
`splat_exp`. Gharbi et al. 2019 (doi:10.1145/3306346.3322954) subtract the largest logit that arrives, a true
softmax over all contributions of a pixel: `models.ops.arrivals`.

Everything runs in float32, or float64 for float64 values, also under mixed precision, is differentiable once
and keeps logits and values only: the backward pass computes weights again (`models.ops.kernel_blocks`).
Memory beyond inputs, outputs and gradients does not grow with the kernels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops import kernel_graph as graph
from models.ops.boxes import exporting
from models.ops.kernel_blocks import Kernels, scatter, slopes
from models.ops.precision import wide


class Splatted(NamedTuple):
    """What arrives at every pixel.

    Attributes:
        total: Weighted values (B, C, H, W), summed.
        weight: Weights (B, 1, H, W), summed.
    """

    total: Tensor
    weight: Tensor


def splat(values: Tensor, weights: Tensor, size: int, beyond: bool = False) -> Splatted:
    """Splat values with given weights; the adjoint of `models.ops.gather_inside.gather_weighted`.

    Args:
        values: (B, N, C, H, W), of N samples or layers.
        weights: (B, N, K * K, H, W); map `K * (dy + r) + dx + r` weighs what goes to the pixel dy rows below
            and dx columns to the right, r = (K - 1) / 2.
        size: K, odd.
        beyond: Return H + K - 1 rows: also the r rows above and below the image that are reached, for images
            that are parts of another.

    Raises:
        ValueError: K is even, there are not K * K weights, or sizes differ.
    """
    return _splatted(values, weights, _Shifts(), size, beyond)


def splat_exp(
    values: Tensor, logits: Tensor, size: int, shift: Tensor | None = None, beyond: bool = False
) -> Splatted:
    """Splat values with weights exp(logit - shift), the shift being that of the pixel that splats.

    Args:
        values: (B, N, C, H, W), of N samples or layers.
        logits: (B, N, K * K, H, W), in the order of `splat`.
        size: K, odd.
        shift: (B, 1 or N, 1, H, W). None: the largest logit of the pixel over all taps and all N, so that
            the largest weight is 1. Where samples come one at a time it is their common maximum. It has a
            gradient, since the result is no function of differences alone.
        beyond: As in `splat`.

    Raises:
        ValueError: As for `splat`, or the shift has another shape.
    """
    if shift is not None:
        return _splatted(values, logits, _Shifts(shift), size, beyond)
    if not exporting():
        check_kernels(values, logits, size)
    return _splatted(values, logits, _own_shifts(logits, size), size, beyond)


def splat_apart(values: Tensor, logits: Tensor, size: int, beyond: bool = False) -> Tensor:
    """Splat layers with weights exp(logit - shift), each into an image of its own.

    The shift is the largest logit of the pixel that splats over all taps and all layers, as in `splat_exp`.

    Args:
        values: (B, N, C, H, W), of N layers.
        logits: (B, N, K * K, H, W), in the order of `splat`.
        size: K, odd.
        beyond: As in `splat`.

    Returns:
        Weighted values, (B, N, C, H or H + K - 1, W).

    Raises:
        ValueError: As for `splat`.
    """
    if not exporting():
        check_kernels(values, logits, size)
    largest = _own_shifts(logits, size)
    assert largest.source is not None
    source = largest.source.expand(values[:, :, :1].shape)
    each = (part.flatten(0, 1)[:, None] for part in (values, logits, source))
    values_of, logits_of, source_of = each
    made = _splatted(values_of, logits_of, largest._replace(source=source_of), size, beyond).total
    return made.reshape(*values.shape[:3], *made.shape[-2:])


def splat_shifted(values: Tensor, logits: Tensor, size: int, shift: Tensor, beyond: bool = False) -> Splatted:
    """Splat values with weights exp(logit - shift), the shift being that of the pixel that is reached.

    Args:
        values: (B, N, C, H, W), of N samples or layers.
        logits: (B, N, K * K, H, W), in the order of `splat`.
        size: K, odd.
        shift: (B, 1, H, W), or H + K - 1 rows with `beyond`; a constant for the gradient, at least about the
            largest logit that arrives.
        beyond: As in `splat`.

    Raises:
        ValueError: As for `splat_exp`.
    """
    return _splatted(values, logits, _Shifts(target=shift.detach()), size, beyond)


def source_maximum(logits: Tensor) -> Tensor:
    """Return the largest logit of every pixel over N images and all taps, (B, 1, 1, H, W)."""
    return logits.amax((1, 2), keepdim=True)


class _Shifts(NamedTuple):
    """What is subtracted from logits: at the pixel that splats, with its place among the N * K * K logits
    of each batch element where it is one of them, and at the pixel that is reached."""

    source: Tensor | None = None
    place: Tensor | None = None
    target: Tensor | None = None


def _splatted(values: Tensor, numbers: Tensor, shifts: _Shifts, size: int, beyond: bool) -> Splatted:
    values = wide(values)
    if not exporting():
        check_kernels(values, numbers, size)
    source, index, target = shifts
    if source is not None:
        source = source.to(values.dtype).expand(values[:, :, :1].shape)
    if target is not None:
        target = target.to(values.dtype)
    if exporting():
        kernels = graph.weights(numbers.to(values.dtype), size, source, target, beyond)
        sums = graph.scatter(values, kernels, size, beyond)
    elif torch.is_grad_enabled() and any(
        t is not None and t.requires_grad for t in (values, numbers, source)
    ):
        sums = _Splat.apply(values, numbers, source, target, index, size, beyond)
    else:
        sums = scatter(Kernels(numbers, size, values.dtype, source, target), values, beyond)
    return Splatted(sums[:, :-1], sums[:, -1:])


def _own_shifts(logits: Tensor, size: int) -> _Shifts:
    """Return `source_maximum`, and for a gradient which logit it is, (B, 1, H, W).

    The largest of each row of taps first: finding places costs 40 times as much as finding values.
    """
    if exporting() or not (torch.is_grad_enabled() and logits.requires_grad):
        return _Shifts(source_maximum(logits))
    logits = logits.detach()
    lines = logits.reshape(len(logits), -1, size, *logits.shape[3:])
    largest, line = lines.amax(2).max(1, keepdim=True)
    taps = torch.gather(lines, 1, line[:, :, None].expand(-1, -1, size, -1, -1))[:, 0]
    return _Shifts(largest[:, None], line * size + taps.argmax(1, keepdim=True))


def check_kernels(values: Tensor, numbers: Tensor, size: int) -> None:
    """Check values (B, N, C, H, W) and weights or logits (B, N, K * K, H, W) of K x K kernels.

    Raises:
        ValueError: K is even, or sizes differ.
    """
    if size < 1 or size % 2 == 0:
        raise ValueError(f"kernel size {size}; expected an odd number")
    batch, count, _, height, width = values.shape
    expected = (batch, count, size * size, height, width)
    if tuple(numbers.shape) != expected:
        raise ValueError(
            f"weights or logits of {size}x{size} kernels have shape {tuple(numbers.shape)}, expected "
            f"{expected} for values of shape {tuple(values.shape)}"
        )


class _Splat(torch.autograd.Function):
    """`scatter` with a backward pass that computes the weights again.

    With incoming gradients g (of totals) and h (of weights), and a_q(p) = h(p + q) + <values(p), g(p + q)>:

        dL/d(values) = sum_q w_q g(p + q),   dL/d(weight_q) = a_q,   dL/d(logit_q) = w_q a_q,
        dL/d(shift) = - sum_q w_q a_q   for the shift of the pixel that splats
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        numbers: Tensor,
        source: Tensor | None,
        target: Tensor | None,
        index: Tensor | None,
        size: int,
        beyond: bool,
    ) -> Tensor:
        ctx.save_for_backward(values, numbers, source, target, index)
        ctx.size = size
        return scatter(Kernels(numbers, size, values.dtype, source, target), values, beyond)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        values, numbers, source, target, index = ctx.saved_tensors
        kernels = Kernels(numbers, ctx.size, values.dtype, source, target)
        for_values, for_numbers, for_source = ctx.needs_input_grad[:3]
        wanted = (for_values, for_numbers, for_source or (for_numbers and index is not None))
        d_values, d_numbers, d_source = slopes(kernels, values, gradient[:, None], wanted)
        if index is not None and d_numbers is not None and d_source is not None:
            # The shift is one of the logits: its gradient goes there.
            change = d_source.reshape(len(index), -1, *index.shape[2:]).sum(1, keepdim=True)
            change = change.to(d_numbers.dtype)
            d_numbers.view(len(change), -1, *change.shape[-2:]).scatter_add_(1, index, change)
        return d_values, d_numbers, d_source if for_source else None, None, None, None, None
