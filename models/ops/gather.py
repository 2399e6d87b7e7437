"""Kernel gather: every pixel is a weighted mean of its neighbours, with weights of its own.

    out(p) = sum_q softmax(logits(p))_q  image(p + q),   q over the K x K offsets, row by row

Source: kernel prediction of Bako et al. 2017 (doi:10.1145/3072959.3073708), section 4. Written down plainly,
the K^2 shifted copies of the image and their products with the weights are all kept; here they are formed a
few rows at a time, and what a training step keeps is the logits alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import exporting
from models.ops.precision import wide

Border = Literal["reflect", "zero"]

_CHUNK = 1 << 13
"""Pixels processed at once on a CPU: 441 weights of each take 14 MB."""

_CHUNK_DEVICE = 1 << 18
"""The same on other devices, where calls cost more and memory less."""


def gather(image: Tensor, logits: Tensor, size: int, border: Border = "reflect") -> Tensor:
    """Filter an image with the kernels that logits predict.

    Runs in float32, or float64 for float64 images, also under mixed precision. Differentiable once; the
    backward pass computes the weights again instead of keeping them. Memory beyond image, logits and their
    gradients does not grow with the image.

    Args:
        image: (B, C, H, W).
        logits: (B, K * K, H, W); map `K * (dy + r) + dx + r` weighs the pixel dy rows below and dx columns to
            the right, r = (K - 1) / 2.
        size: K, odd.
        border: What lies outside the image: its mirror image, or zeros, which take weight (not renormalised).

    Returns:
        (B, C, H, W).

    Raises:
        ValueError: K is even, there are not K * K logits, sizes differ, or an image is too small to be
            mirrored.
    """
    if not exporting():
        _check(image, logits, size, border)
    return gather_padded(pad_border(image, size // 2, border), logits, size)


def gather_padded(padded: Tensor, logits: Tensor, size: int) -> Tensor:
    """Filter an image that has its border already: `gather` without the padding.

    Args:
        padded: (B, C, H + K - 1, W + K - 1).
        logits: (B, K * K, H, W).
        size: K, odd.

    Returns:
        (B, C, H, W).
    """
    padded = wide(padded)
    if exporting():
        return _gather_exported(padded, logits.to(padded.dtype), size)
    if torch.is_grad_enabled() and (padded.requires_grad or logits.requires_grad):
        result: Tensor = _Gather.apply(padded, logits, size)
        return result
    return _forward(padded, logits, size)


def pad_border(image: Tensor, radius: int, border: Border) -> Tensor:
    """Return the image with `radius` more pixels on every side, mirrored or zero."""
    return F.pad(image, [radius] * 4, mode="reflect" if border == "reflect" else "constant")


def strips(height: int, pixels: int, like: Tensor) -> Iterator[slice]:
    """Return the groups of rows that are processed at once.

    Args:
        height: Rows in all.
        pixels: Pixels of one row, of all images together.
        like: Tells the device.
    """
    limit = _CHUNK if like.device.type == "cpu" else _CHUNK_DEVICE
    rows = max(1, limit // max(pixels, 1))
    return (slice(first, min(height, first + rows)) for first in range(0, height, rows))


def _check(image: Tensor, logits: Tensor, size: int, border: Border) -> None:
    if size < 1 or size % 2 == 0:
        raise ValueError(f"kernel size {size}; expected an odd number")
    if border not in ("reflect", "zero"):
        raise ValueError(f"border {border!r}; expected 'reflect' or 'zero'")
    batch, _, height, width = image.shape
    if tuple(logits.shape) != (batch, size * size, height, width):
        raise ValueError(
            f"logits have shape {tuple(logits.shape)}, expected {(batch, size * size, height, width)} for "
            f"kernels of {size}x{size}"
        )
    if border == "reflect" and min(height, width) <= size // 2:
        raise ValueError(
            f"an image of {width}x{height} cannot be mirrored by {size // 2} pixels; expected at least "
            f"{size // 2 + 1} rows and columns, or border='zero'"
        )


def _windows(padded: Tensor, width: int) -> Tensor:
    """Return the view (B, C, K, H + K - 1, W) of the K horizontally shifted images; nothing is copied."""
    return padded.unfold(3, width, 1).transpose(2, 3)


def _weights(logits: Tensor, dtype: torch.dtype) -> Tensor:
    return torch.softmax(logits.to(dtype), 1)


def _forward(padded: Tensor, logits: Tensor, size: int) -> Tensor:
    batch, _, height, width = logits.shape
    shifted = _windows(padded, width)
    result = padded.new_zeros(batch, padded.shape[1], height, width)
    for rows in strips(height, batch * width, logits):
        weights, part = _weights(logits[:, :, rows], padded.dtype), result[:, :, rows]
        for dy in range(size):
            row = weights[:, dy * size : (dy + 1) * size]
            seen = shifted[:, :, :, rows.start + dy : rows.stop + dy]
            for channel in range(padded.shape[1]):
                part[:, channel] += (row * seen[:, channel]).sum(1)
    return result


class _Gather(torch.autograd.Function):
    """`_forward` with a backward pass that keeps image and logits only.

    With weights w, incoming gradient g and s_q the image shifted by q:

        dL/d(logit_q) = w_q (sum_c g_c s_qc - sum_c g_c out_c),    dL/d(s_q) = w_q g
    """

    @staticmethod
    def forward(ctx: Any, padded: Tensor, logits: Tensor, size: int) -> Tensor:
        result = _forward(padded, logits, size)
        ctx.save_for_backward(padded, logits, result)
        ctx.size = size
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        padded, logits, result = ctx.saved_tensors
        batch, _, height, width = logits.shape
        for_image, for_logits = ctx.needs_input_grad[:2]
        d_padded = torch.zeros_like(padded) if for_image else None
        d_logits = torch.empty_like(logits) if for_logits else None
        mean = (gradient * result).sum(1, keepdim=True)
        for rows in strips(height, batch * width, logits):
            weights, incoming = _weights(logits[:, :, rows], padded.dtype), gradient[:, :, rows]
            if d_padded is not None:
                _scatter(d_padded[:, :, rows.start : rows.stop + ctx.size - 1], weights, incoming, ctx.size)
            if d_logits is not None:
                products = _products(padded, incoming, rows, ctx.size)
                d_logits[:, :, rows] = products.sub_(mean[:, :, rows]).mul_(weights)
        return d_padded, d_logits, None


def _products(padded: Tensor, incoming: Tensor, rows: slice, size: int) -> Tensor:
    """Return sum_c g_c s_qc, (B, K * K, rows, W)."""
    batch, channels, height, width = incoming.shape
    shifted = _windows(padded, width)
    result = incoming.new_empty(batch, size * size, height, width)
    for dy in range(size):
        part = result[:, dy * size : (dy + 1) * size]
        seen = shifted[:, :, :, rows.start + dy : rows.stop + dy]
        torch.mul(seen[:, 0], incoming[:, :1], out=part)
        for channel in range(1, channels):
            part.addcmul_(seen[:, channel], incoming[:, channel : channel + 1])
    return result


def _scatter(image: Tensor, weights: Tensor, incoming: Tensor, size: int) -> None:
    """Add w_q g to the image (B, C, rows + K - 1, W + K - 1) at every offset q."""
    height, width = incoming.shape[-2:]
    for index in range(size * size):
        dy, dx = divmod(index, size)
        image[:, :, dy : dy + height, dx : dx + width].addcmul_(weights[:, index : index + 1], incoming)


def _gather_exported(padded: Tensor, logits: Tensor, size: int) -> Tensor:
    """The same as a graph of 5 K nodes per channel, for other runtimes.

    A convolution with the K unit vectors makes the K horizontally shifted images of a channel: one node in
    place of K^2 slices. Softmax is written out, since ONNX Runtime transposes the image for it. All
    slices have constant bounds, counted from the end, so that every size runs.
    """
    units = torch.eye(size).reshape(size, 1, 1, size).to(padded)
    weights = torch.exp(logits - logits.amax(1, keepdim=True))
    totals: list[Tensor] = []
    for image in padded.split(1, 1):
        shifted = F.conv2d(image, units)
        total: Tensor | None = None
        for dy in range(size):
            below = dy - size + 1
            seen = shifted[:, :, dy:below] if below else shifted[:, :, dy:]
            term = (weights[:, dy * size : (dy + 1) * size] * seen).sum(1, keepdim=True)
            total = term if total is None else total + term
        assert total is not None
        totals.append(total)
    return torch.cat(totals, 1) / weights.sum(1, keepdim=True)
