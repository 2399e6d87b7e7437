"""Convolutions with reflected borders and their activation, keeping less for the backward pass.

PyTorch keeps the padded copy of the input, the result of the activation, and a concatenation of inputs where
there is one. Here the copy is made again in the backward pass, a result that only ends in a sum is kept as
one bit's worth of sign, and a 1x1 convolution of several inputs is a sum of convolutions. All are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import exporting


def reflect_conv(
    images: Tensor,
    weight: Tensor,
    bias: Tensor,
    radius: int,
    slope: float = 0.0,
    residual: Tensor | None = None,
) -> Tensor:
    """Return leaky_relu(convolution(images), slope) [+ residual] of the same size, borders reflected.

    Under autocast the convolution runs in its type and the sum in the type of `residual`.
    Differentiable once.

    Args:
        images: (B, C, H, W), H and W larger than the radius.
        weight: (D, C, K, K) with K = 2 radius + 1.
        bias: (D,).
        radius: Pixels that are reflected at each border; traced graphs need it as a number.
        slope: Of negative values; 0 is a ReLU, 1 leaves the result linear.
        residual: (B, D, H, W), added at the end.
    """
    images, weight, bias = _autocast(images, weight, bias)
    with torch.autocast(images.device.type, enabled=False):
        tensors = (images, weight, bias) if residual is None else (images, weight, bias, residual)
        if exporting() or not (torch.is_grad_enabled() and any(t.requires_grad for t in tensors)):
            return _added(_convolved(images, weight, bias, radius, slope), residual)
        result: Tensor = _ReflectConv.apply(images, weight, bias, radius, slope, residual)
        return result


def pointwise(images: Sequence[Tensor], weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return the 1x1 convolution of the images' concatenated channels, without concatenating them.

    Args:
        images: Tensors (B, C, H, W), equal in channels.
        weight: (D, number of images times C, 1, 1).
        bias: (D,).
    """
    parts = weight.chunk(len(images), 1)
    total = F.conv2d(images[0], parts[0], bias)
    for image, part in zip(images[1:], parts[1:], strict=True):
        total = total + F.conv2d(image, part) if exporting() else total.add_(F.conv2d(image, part))
    return total


def _autocast(*tensors: Tensor) -> tuple[Tensor, ...]:
    device = tensors[0].device.type
    if not torch.is_autocast_enabled(device):
        return tensors
    return tuple(t.to(torch.get_autocast_dtype(device)) for t in tensors)


def _reflected(images: Tensor, radius: int) -> Tensor:
    return F.pad(images, [radius] * 4, mode="reflect") if radius else images


def _convolved(images: Tensor, weight: Tensor, bias: Tensor, radius: int, slope: float) -> Tensor:
    result = F.conv2d(_reflected(images, radius), weight, bias)
    if slope == 1:
        return result
    return F.relu_(result) if slope == 0 else F.leaky_relu_(result, slope)


def _added(result: Tensor, residual: Tensor | None) -> Tensor:
    if residual is None:
        return result
    return result + residual if exporting() or result.dtype != residual.dtype else result.add_(residual)


class _ReflectConv(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        images: Tensor,
        weight: Tensor,
        bias: Tensor,
        radius: int,
        slope: float,
        residual: Tensor | None,
    ) -> Tensor:
        result = _convolved(images, weight, bias, radius, slope)
        ctx.radius, ctx.slope = radius, slope
        if slope == 1:
            ctx.save_for_backward(images, weight)
        else:
            ctx.save_for_backward(images, weight, result if residual is None else result > 0)
        return _added(result, residual)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, weight, *rest = ctx.saved_tensors
        own = gradient.to(images.dtype)
        if rest:
            positive = rest[0] if rest[0].dtype == torch.bool else rest[0] > 0
            own = torch.where(positive, own, own * ctx.slope if ctx.slope else 0.0)
        wanted = list(ctx.needs_input_grad[:3])
        d_images, d_weight, d_bias = torch.ops.aten.convolution_backward(
            own, _reflected(images, ctx.radius), weight, [weight.shape[0]],
            [1, 1], [0, 0], [1, 1], False, [0, 0], 1, wanted,
        )  # fmt: skip
        if wanted[0] and ctx.radius:
            d_images = torch.ops.aten.reflection_pad2d_backward(d_images, images, [ctx.radius] * 4)
        return d_images, d_weight, d_bias, None, None, gradient if ctx.needs_input_grad[5] else None
