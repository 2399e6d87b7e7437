"""Conditioned feature modulation and the convolution behind it, without keeping what lies between.

For maps x (B, C, H, W) and a condition c (B, K, H, W)

    y = conv3x3(x * (1 + S(c)) + T(c)),   S, T: 1x1 convolution K -> K, leaky ReLU 0.1, 1x1 convolution K -> C

(Xu et al. 2019, doi:10.1145/3355089.3356547). Written with modules, training keeps seven maps for each of
these; here it keeps x. The 1x1 convolutions are matrix products over pixels, done for some thousand pixels at
a time, so that what lies between stays in the processor's cache; the backward pass computes them again.

Weights are those of the modules: (K, K, 1, 1), (C, K, 1, 1) and (C, C, 3, 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

SLOPE = 0.1
"""Of the leaky ReLUs of S and T."""
_PIXELS = 2048
"""Pixels done at a time on a CPU: 64 channels of them are 0.5 MB in float32."""


class Weights(NamedTuple):
    """Weights and biases of S, T and the convolution."""

    scale_in: Tensor
    scale_in_bias: Tensor
    scale_out: Tensor
    scale_out_bias: Tensor
    shift_in: Tensor
    shift_in_bias: Tensor
    shift_out: Tensor
    shift_out_bias: Tensor
    convolution: Tensor
    convolution_bias: Tensor


def modulated_convolution(maps: Tensor, condition: Tensor, weights: Weights) -> Tensor:
    """Return y (B, C, H, W), differentiable once; fastest with channels innermost in memory.

    Under autocast everything is computed in autocast's precision, sums of gradients in float32.

    Args:
        maps: x, (B, C, H, W).
        condition: c, (B, K, H, W).
        weights: As the modules hold them.
    """
    kind = maps.device.type
    if torch.is_autocast_enabled(kind):
        dtype = torch.get_autocast_dtype(kind)
        maps, condition = maps.to(dtype), condition.to(dtype)
        weights = Weights(*(weight.to(dtype) for weight in weights))
    if torch.is_grad_enabled():
        result: Tensor = _ModulatedConvolution.apply(maps, condition, *weights)
        return result
    return _convolve(_modulate(maps, condition, weights), weights)


def plain_modulated_convolution(maps: Tensor, condition: Tensor, weights: Weights) -> Tensor:
    """Return the same from single operations: the form for tracing and export."""
    scale, shift = (
        F.conv2d(F.leaky_relu(F.conv2d(condition, *first), SLOPE), *second)
        for first, second in ((weights[0:2], weights[2:4]), (weights[4:6], weights[6:8]))
    )
    return F.conv2d(maps * (scale + 1) + shift, *weights[8:10], padding=1)


class _Branch(NamedTuple):
    """Weights of S or T as matrices (K, K) and (C, K)."""

    first: Tensor
    first_bias: Tensor
    second: Tensor
    second_bias: Tensor

    def hidden(self, condition: Tensor) -> Tensor:
        """Return what leaves the first layer, (P, K)."""
        return F.leaky_relu_(torch.addmm(self.first_bias, condition, self.first.t()), SLOPE)

    def result(self, hidden: Tensor) -> Tensor:
        """Return what leaves the second layer, (P, C)."""
        return torch.addmm(self.second_bias, hidden, self.second.t())


def _branches(weights: Weights) -> tuple[_Branch, _Branch]:
    """Return 1 + S and T."""
    flat = [weight.flatten(1) if weight.ndim > 1 else weight for weight in weights[:8]]
    scale, shift = _Branch(*flat[:4]), _Branch(*flat[4:])
    return scale._replace(second_bias=scale.second_bias + 1), shift


def _rows(maps: Tensor) -> Tensor:
    """Return (B, C, H, W) as (B * H * W, C), a view where channels are innermost."""
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1])


def _maps(rows: Tensor, like: Tensor) -> Tensor:
    batch, _, height, width = like.shape
    return rows.view(batch, height, width, rows.shape[1]).permute(0, 3, 1, 2)


def _pieces(rows: Tensor) -> list[slice]:
    count, step = rows.shape[0], _PIXELS if rows.device.type == "cpu" else max(rows.shape[0], 1)
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


def _modulate(maps: Tensor, condition: Tensor, weights: Weights) -> Tensor:
    rows, guides = _rows(maps), _rows(condition)
    result, (one_plus_scale, shift) = torch.empty_like(rows), _branches(weights)
    for piece in _pieces(rows):
        factor, term = (branch.result(branch.hidden(guides[piece])) for branch in (one_plus_scale, shift))
        torch.addcmul(term, rows[piece], factor, out=result[piece])
    return _maps(result, maps)


def _convolve(maps: Tensor, weights: Weights) -> Tensor:
    return F.conv2d(maps, weights.convolution, weights.convolution_bias, padding=1)


class _ModulatedConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, condition: Tensor, *flat: Tensor) -> Tensor:
        ctx.save_for_backward(maps, condition, *flat)
        weights = Weights(*flat)
        return _convolve(_modulate(maps, condition, weights), weights)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        maps, condition, *flat = ctx.saved_tensors
        weights, needs = Weights(*flat), ctx.needs_input_grad
        modulated = _modulate(maps, condition, weights)
        inner, kernel, bias = torch.ops.aten.convolution_backward(
            *(gradient, modulated, weights.convolution, list(weights.convolution_bias.shape)),
            *([1, 1], [1, 1], [1, 1], False, [0, 0], 1, [True, needs[10], needs[11]]),
        )
        del modulated
        if not any(needs[:10]):
            return (None,) * 10 + (kernel, bias)
        rows, guides, small = _modulation_backward(maps, condition, inner, weights)
        found = (
            rows,
            guides,
            *(_like(one, like) for one, like in zip(small, flat[:8], strict=True)),
            kernel,
            bias,
        )
        return tuple(one if need else None for one, need in zip(found, needs, strict=True))


def _like(gradient: Tensor, weight: Tensor) -> Tensor:
    return gradient.to(weight.dtype).view_as(weight)


def _modulation_backward(
    maps: Tensor, condition: Tensor, gradient: Tensor, weights: Weights
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Return the gradients of x, of c, and of the weights in the order of `Weights`, these in float32."""
    rows, guides, above = _rows(maps), _rows(condition), _rows(gradient)
    to_maps, to_condition = torch.empty_like(rows), torch.empty_like(guides)
    wide = rows.dtype if rows.dtype == torch.float64 else torch.float32
    sums = [torch.zeros_like(weight, dtype=wide) for branch in _branches(weights) for weight in branch]
    one_plus_scale, shift = _branches(weights)
    for piece in _pieces(rows):
        guide, to_shift = guides[piece], above[piece]
        hidden = one_plus_scale.hidden(guide)
        factor = one_plus_scale.result(hidden)
        torch.mul(to_shift, factor, out=to_maps[piece])
        to_scale = torch.mul(to_shift, rows[piece], out=factor)
        found = _branch_backward(one_plus_scale, guide, hidden, to_scale, sums[:4])
        found += _branch_backward(shift, guide, shift.hidden(guide), to_shift, sums[4:])
        to_condition[piece] = found
    return _maps(to_maps, maps), _maps(to_condition, condition), sums


def _branch_backward(
    branch: _Branch, guide: Tensor, hidden: Tensor, gradient: Tensor, sums: list[Tensor]
) -> Tensor:
    """Add the gradients of a branch's weights to the sums and return that of the condition."""
    # The sign of what left a leaky ReLU is the sign of what entered it.
    to_hidden = torch.ops.aten.leaky_relu_backward(torch.mm(gradient, branch.second), hidden, SLOPE, True)
    for index, (left, right) in enumerate(((to_hidden, guide), (gradient, hidden))):
        _accumulate(sums[2 * index], left, right)
        sums[2 * index + 1] += left.sum(0, dtype=sums[0].dtype)
    return torch.mm(to_hidden, branch.first)


def _accumulate(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Add left' right to the total."""
    if total.dtype == left.dtype:
        total.addmm_(left.t(), right)
    else:
        total += torch.mm(left.t(), right)
