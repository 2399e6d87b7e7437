"""Scatter, collect and their gradients (`models.ops.kernel_blocks`), one program for each block of pixels.

A scatter is written as what its target pixels collect, so nothing is added atomically and results repeat. A
weight exists in registers only, in the backward pass too, where it is computed again.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 128
"""Pixels of a program."""


@triton.jit
def _scatter(  # type: ignore[no-untyped-def]
    numbers, values, source, target, out, N, C, H, W, rows, margin,
    K: tl.constexpr, LINES: tl.constexpr, SOURCE: tl.constexpr, TARGET: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = place < rows * W
    y, x = place // W - margin, place % W
    line = tl.arange(0, LINES)[:, None]
    sums = tl.zeros([LINES, BLOCK], out.dtype.element_ty)
    if TARGET:
        reached = tl.load(target + b * rows * W + place, mask=inside, other=0.0)
    for n in range(N):
        image = b * N + n
        for tap in range(K * K):
            above, left = y - tap // K + K // 2, x - tap % K + K // 2
            there = inside & (above >= 0) & (above < H) & (left >= 0) & (left < W)
            pixel = above * W + left
            weight = tl.load(numbers + (image * K * K + tap) * H * W + pixel, mask=there, other=0.0)
            weight = weight.to(out.dtype.element_ty)
            if SOURCE:
                weight -= tl.load(source + image * H * W + pixel, mask=there, other=0.0)
            if TARGET:
                weight -= reached
            if SOURCE or TARGET:
                weight = tl.exp(weight)
            weight = tl.where(there, weight, 0.0)
            sent = tl.load(
                values + (image * C + line) * H * W + pixel[None], mask=there[None] & (line < C), other=0.0
            )
            sums += tl.where(line == C, 1.0, sent) * weight[None]
    tl.store(out + (b * (C + 1) + line) * rows * W + place[None], sums, mask=inside[None] & (line <= C))


@triton.jit
def _slopes(  # type: ignore[no-untyped-def]
    numbers, own, other, source, target, d_own, d_numbers, d_source,
    N, SHARED, C, CHANNELS, H, W, rows, margin,
    K: tl.constexpr, LINES: tl.constexpr, SOURCE: tl.constexpr, TARGET: tl.constexpr,
    FOR_OWN: tl.constexpr, FOR_NUMBERS: tl.constexpr, FOR_SOURCE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    image = tl.program_id(1).to(tl.int64)
    seen_image = image // N if SHARED else image
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = place < H * W
    y, x = place // W, place % W
    line = tl.arange(0, LINES)[:, None]
    kind = other.dtype.element_ty
    if FOR_NUMBERS or FOR_SOURCE:
        held = tl.load(
            own + (image * C + line) * H * W + place[None], mask=inside[None] & (line < C), other=0.0
        )
        held = tl.where((line == C) & (line < CHANNELS), 1.0, held)
    if SOURCE:
        shift = tl.load(source + image * H * W + place, mask=inside, other=0.0)
    sums = tl.zeros([LINES, BLOCK], kind)
    total = tl.zeros([BLOCK], kind)
    for tap in range(K * K):
        below, right = y + tap // K - K // 2 + margin, x + tap % K - K // 2
        there = inside & (below >= 0) & (below < rows) & (right >= 0) & (right < W)
        pixel = below * W + right
        seen = tl.load(
            other + (seen_image * CHANNELS + line) * rows * W + pixel[None],
            mask=there[None] & (line < CHANNELS), other=0.0,
        )  # fmt: skip
        number = (image * K * K + tap) * H * W + place
        weight = tl.load(numbers + number, mask=there, other=0.0).to(kind)
        if SOURCE:
            weight -= shift
        if TARGET:
            weight -= tl.load(target + (image // N) * rows * W + pixel, mask=there, other=0.0)
        if SOURCE or TARGET:
            weight = tl.exp(weight)
        weight = tl.where(there, weight, 0.0)
        if FOR_OWN:
            sums += weight[None] * seen
        if FOR_NUMBERS or FOR_SOURCE:
            slope = tl.sum(held * seen, 0)
            if SOURCE or TARGET:
                slope *= weight
            total -= slope
            if FOR_NUMBERS:
                tl.store(d_numbers + number, slope.to(d_numbers.dtype.element_ty), mask=inside)
    if FOR_OWN:
        tl.store(d_own + (image * C + line) * H * W + place[None], sums, mask=inside[None] & (line < C))
    if FOR_SOURCE:
        tl.store(d_source + image * H * W + place, total, mask=inside)


def scatter(kernels: Any, values: Tensor, beyond: bool = False) -> Tensor:
    """As `models.ops.kernel_blocks.scatter`."""
    batch, count, channels, height, width = values.shape
    margin = kernels.margin(beyond)
    rows = height + 2 * margin
    numbers, values, source, target = _plain(kernels.numbers, values, kernels.source, kernels.target)
    out = values.new_empty(batch, channels + 1, rows, width)
    grid = (triton.cdiv(rows * width, _BLOCK), batch)
    _scatter[grid](
        *(numbers, values, source, target, out, count, channels, height, width, rows, margin),
        K=kernels.size,
        LINES=triton.next_power_of_2(channels + 1),
        SOURCE=kernels.source is not None,
        TARGET=kernels.target is not None,
        BLOCK=_BLOCK,
    )
    return out


def slopes(
    kernels: Any, own: Tensor, other: Tensor, wanted: tuple[bool, bool, bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """As `models.ops.kernel_blocks.slopes`."""
    batch, count, channels, height, width = own.shape
    rows, lines = other.shape[-2], max(channels, other.shape[2])
    numbers, own, other, source, target = _plain(kernels.numbers, own, other, kernels.source, kernels.target)
    made = (
        torch.empty_like(own) if wanted[0] else None,
        torch.empty_like(numbers) if wanted[1] else None,
        own.new_empty(own[:, :, :1].shape) if wanted[2] else None,
    )
    grid = (triton.cdiv(height * width, _BLOCK), batch * count)
    _slopes[grid](
        *(numbers, own, other, source, target, *(own if d is None else d for d in made)),
        *(
            count,
            int(other.shape[1] == 1),
            channels,
            other.shape[2],
            height,
            width,
            rows,
            (rows - height) // 2,
        ),
        K=kernels.size,
        LINES=triton.next_power_of_2(lines),
        SOURCE=kernels.source is not None,
        TARGET=kernels.target is not None,
        FOR_OWN=wanted[0],
        FOR_NUMBERS=wanted[1],
        FOR_SOURCE=wanted[2],
        BLOCK=_BLOCK,
    )
    return made


def collect(kernels: Any, image: Tensor) -> Tensor:
    """As `models.ops.kernel_blocks.collect`."""
    height = kernels.numbers.shape[-2]
    own = image.narrow(-2, (image.shape[-2] - height) // 2, height)  # only its shape counts
    made = slopes(kernels, own, image, (True, False, False))[0]
    assert made is not None
    return made


def _plain(numbers: Tensor, *images: Tensor | None) -> list[Tensor]:
    """Return tensors without gaps; where there is none, one that is never read."""
    return [numbers.contiguous(), *(numbers if image is None else image.contiguous() for image in images)]
