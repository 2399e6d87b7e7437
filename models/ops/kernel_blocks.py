"""Kernels of every pixel, evaluated a few rows and taps at a time: what splats and gathers are made of.

A K x K kernel belongs to every pixel p of an image. The two operations, each the adjoint of the other:

    scatter:  out(p + q) += w_q(p) values(p)          collect:  out(p) = sum_q w_q(p) image(p + q)

with q over the K x K offsets, row by row. Offsets that leave the image are left out. Weights are numbers
themselves, or exp(number - shift), where the shift belongs to the pixel that owns the kernel or to the pixel
that is reached. Blocks of K taps of a strip of rows fit into the cache; no weight outlives its block.

A strip of rows is reached from K other strips, one for each row of taps. Their products are added up tap by
tap first; the K sums are brought to the columns that they go to once in the end. On CUDA devices with Triton
the kernels of `models.ops.triton` do the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops import triton

_CHUNK = 1 << 17
"""Numbers of a block on a CPU. Three channels need five blocks, 2.6 MB, shared by the caches of the cores."""

_CHUNK_DEVICE = 1 << 24
"""The same on other devices, where calls cost more and memory less."""


class Slopes(NamedTuple):
    """Gradients: of what pixels send (B, N, C, H, W), of numbers and of the source shift; None: not asked."""

    own: Tensor | None
    numbers: Tensor | None
    source: Tensor | None


@dataclass(frozen=True)
class Kernels:
    """Kernels of N images (samples, layers) per batch element.

    Attributes:
        numbers: (B, N, K * K, H, W); map `K * (dy + r) + dx + r` belongs to the pixel dy rows below and dx
            columns to the right.
        size: K, odd.
        dtype: What weights are computed in.
        source: Subtracted before exp at the pixel that owns the kernel, (B, N, 1, H, W).
        target: Subtracted before exp at the pixel that is reached, (B, 1, H + 2 m, W), m as below; offsets
            that leave the image get weight 0, whatever their numbers. Without any shift the numbers are the
            weights.
    """

    numbers: Tensor
    size: int
    dtype: torch.dtype
    source: Tensor | None = None
    target: Tensor | None = None

    @property
    def radius(self) -> int:
        """Rows and columns that a kernel reaches."""
        return self.size // 2

    @property
    def exponential(self) -> bool:
        """Whether weights are exponentials of the numbers."""
        return self.source is not None or self.target is not None

    def margin(self, beyond: bool) -> int:
        """Return m, the rows above and below the image that count: those that are reached, or none."""
        return self.radius if beyond else 0

    def images(self) -> Iterator[tuple[int, int, Kernels]]:
        """Return b, n and the kernels of that image alone, (K * K, H, W)."""
        for b in range(self.numbers.shape[0]):
            # Offsets that leave the image meet an infinite shift: no weight.
            target = None
            if self.target is not None:
                target = _padded(self.target[b], self.radius, self.numbers.shape[-2], torch.inf)
            for n in range(self.numbers.shape[1]):
                source = None if self.source is None else self.source[b, n]
                yield b, n, Kernels(self.numbers[b, n], self.size, self.dtype, source, target)

    def block(self, rows: slice, dy: int, out: Tensor) -> None:
        """Write the weights of one row of taps, (K, rows, W); for the kernels of one image."""
        numbers = self.numbers[dy * self.size : (dy + 1) * self.size, rows]
        if not self.exponential:
            out.copy_(numbers)
            return
        shifted = numbers.to(self.dtype)
        if self.source is not None:
            shifted = torch.sub(shifted, self.source[:, rows], out=out)
        if self.target is not None:
            seen = windows(self.target, numbers.shape[-1])[0, :, rows.start + dy : rows.stop + dy]
            torch.sub(shifted, seen, out=out)
        out.exp_()


def windows(padded: Tensor, width: int) -> Tensor:
    """Return the view (C, K, H + K - 1, W) of the K horizontally shifted images (C, H + K - 1, W + K - 1)."""
    return padded.unfold(2, width, 1).transpose(1, 2)


def scatter(kernels: Kernels, values: Tensor, beyond: bool = False) -> Tensor:
    """Send values to the pixels around.

    Args:
        kernels: B x N images of them.
        values: (B, N, C, H, W).
        beyond: Also return the r rows above and below the image that are reached.

    Returns:
        Sums over n, (B, C + 1, H or H + 2 r, W), in the last channel of weights.
    """
    if triton.usable(values):
        return _compiled().scatter(kernels, values, beyond)
    batch, _, channels, height, width = values.shape
    margin = kernels.margin(beyond)
    out = values.new_zeros(batch, channels + 1, height + 2 * margin, width)
    for b, n, one in kernels.images():
        for rows in strips(height + 2 * margin, width, kernels.size, values):
            _scatter_strip(one, rows, margin, values[b, n], out[b, :, rows])
    return out


def collect(kernels: Kernels, image: Tensor) -> Tensor:
    """Return the sums (B, N, C, H, W) that kernels make of images of H or H + 2 r rows; outside is 0."""
    if triton.usable(image):
        return _compiled().collect(kernels, image)
    height, width = kernels.numbers.shape[-2:]
    out = image.new_empty(*image.shape[:3], height, width)
    for b, n, one in kernels.images():
        shifted = windows(_padded(image[b, n], kernels.radius, height), width)
        for rows in strips(height, width, kernels.size, image):
            weights = _block(one, rows, width)
            sums = weights.new_zeros(image.shape[2], *weights.shape)
            for dy in range(kernels.size):
                one.block(rows, dy, weights)
                for channel, seen in enumerate(shifted[:, :, rows.start + dy : rows.stop + dy]):
                    sums[channel].addcmul_(weights, seen)
            out[b, n, :, rows] = sums.sum(1)
    return out


def slopes(kernels: Kernels, own: Tensor, other: Tensor, wanted: tuple[bool, bool, bool]) -> Slopes:
    """Return the gradients of sum over n, q, p of w_q(p) <own(p), other(p + q)>.

    Args:
        kernels: B x N images of them.
        own: (B, N, C, H, W), at the pixels that own the kernels.
        other: (B, N or 1, C or C + 1, H or H + 2 r, W), at those that are reached; a last channel that `own`
            does not have meets 1.
        wanted: Which of own, numbers and source shift.
    """
    if triton.usable(own):
        return Slopes(*_compiled().slopes(kernels, own, other, wanted))
    numbers = kernels.numbers
    d_own = torch.zeros_like(own) if wanted[0] else None
    d_numbers = numbers.new_empty(numbers.shape) if wanted[1] else None
    d_source = own.new_zeros(own[:, :, :1].shape) if wanted[2] else None
    for b, n, one in kernels.images():
        reached = _padded(other[b, n % other.shape[1]], kernels.radius, own.shape[-2])
        shifted = windows(reached, own.shape[-1])
        for rows in strips(own.shape[-2], own.shape[-1], kernels.size, own):
            parts = Slopes(*(None if d is None else d[b, n, :, rows] for d in (d_own, d_numbers, d_source)))
            _slopes_strip(one, rows, own[b, n, :, rows], shifted, parts)
    return Slopes(d_own, d_numbers, d_source)


def arriving_maximum(numbers: Tensor, size: int, beyond: bool = False) -> Tensor:
    """Return the largest number that reaches each pixel.

    Args:
        numbers: (B, N, K * K, H, W).
        size: K, odd.
        beyond: As in `scatter`.

    Returns:
        (B, 1, H or H + 2 r, W).
    """
    batch, _, _, height, width = numbers.shape
    kernels = Kernels(numbers, size, numbers.dtype)
    margin = kernels.margin(beyond)
    out = numbers.new_full((batch, 1, height + 2 * margin, width), -torch.inf)
    for b, _, one in kernels.images():
        for rows in strips(height + 2 * margin, width, size, numbers):
            buffer = _gutters(one, rows, width, 1, -torch.inf)
            largest = buffer[0, :, :, one.radius : one.radius + width]
            for dy, source, part in _arriving(one, rows, margin, height):
                taps = one.numbers[dy * size : (dy + 1) * size, source]
                torch.maximum(largest[:, part], taps, out=largest[:, part])
            out[b, :, rows] = torch.maximum(out[b, :, rows], _aligned(buffer, width).amax(1))
    return out


def strips(height: int, width: int, size: int, like: Tensor) -> Iterator[slice]:
    """Return the groups of rows whose blocks of K taps are handled at once."""
    limit = _CHUNK if like.device.type == "cpu" else _CHUNK_DEVICE
    rows = max(1, limit // (size * width))
    return (slice(first, min(height, first + rows)) for first in range(0, height, rows))


def _compiled() -> Any:
    return import_module("models.ops.triton.kernel_sums")


def _scatter_strip(kernels: Kernels, rows: slice, margin: int, values: Tensor, out: Tensor) -> None:
    """Add what reaches some rows to out (C + 1, rows, W), from values (C, H, W); row 0 is `margin` above."""
    channels, height, width = values.shape
    buffer = _gutters(kernels, rows, width, channels + 1, 0.0)
    sums = buffer[..., kernels.radius : kernels.radius + width]
    weights = _block(kernels, rows, width)
    for dy, source, part in _arriving(kernels, rows, margin, height):
        block = weights.flatten()[: weights[:, part].numel()].view(
            kernels.size, -1, width
        )  # contiguous: exp is fast
        kernels.block(source, dy, block)
        sums[channels, :, part] += block
        for channel in range(channels):
            sums[channel, :, part].addcmul_(block, values[channel, source])
    out += _aligned(buffer, width).sum(1)


def _slopes_strip(kernels: Kernels, rows: slice, own: Tensor, shifted: Tensor, parts: Slopes) -> None:
    """Write or add the gradients of some rows; own (C, rows, W), parts likewise."""
    channels, _, width = own.shape
    weights = _block(kernels, rows, width)
    products = torch.empty_like(weights)
    sums = weights.new_zeros(channels, *weights.shape) if parts.own is not None else None
    for dy in range(kernels.size):
        seen = shifted[:, :, rows.start + dy : rows.stop + dy]
        if sums is not None or kernels.exponential:
            kernels.block(rows, dy, weights)
        if sums is not None:
            for channel in range(channels):
                sums[channel].addcmul_(weights, seen[channel])
        if parts.numbers is None and parts.source is None:
            continue
        _products(own, seen, products)
        if kernels.exponential:
            products.mul_(weights)
        if parts.source is not None:
            parts.source[0] -= products.sum(0)
        if parts.numbers is not None:
            parts.numbers[dy * kernels.size : (dy + 1) * kernels.size] = products
    if parts.own is not None and sums is not None:
        parts.own.copy_(sums.sum(1))


def _products(own: Tensor, seen: Tensor, out: Tensor) -> None:
    """Write <own (C, rows, W), seen (C, K, rows, W)>, plus what `seen` has beyond C channels."""
    if len(seen) > len(own):
        torch.addcmul(seen[-1], seen[0], own[0], out=out)
    else:
        torch.mul(seen[0], own[0], out=out)
    for channel in range(1, len(own)):
        out.addcmul_(seen[channel], own[channel])


def _arriving(kernels: Kernels, rows: slice, margin: int, height: int) -> Iterator[tuple[int, slice, slice]]:
    """Return, for every row of taps, the rows that send to `rows` and where among these they arrive."""
    for dy in range(kernels.size):
        start = rows.start - margin - (dy - kernels.radius)
        first, last = max(start, 0), min(start + rows.stop - rows.start, height)
        if first < last:
            yield dy, slice(first, last), slice(first - start, last - start)


def _block(kernels: Kernels, rows: slice, width: int) -> Tensor:
    return kernels.numbers.new_empty((kernels.size, rows.stop - rows.start, width), dtype=kernels.dtype)


def _gutters(kernels: Kernels, rows: slice, width: int, channels: int, value: float) -> Tensor:
    """Return a block for every channel, (C, K, rows, W + K - 1), full of a value."""
    sizes = (channels, kernels.size, rows.stop - rows.start, width + 2 * kernels.radius)
    return kernels.numbers.new_full(sizes, value, dtype=kernels.dtype)


def _aligned(buffer: Tensor, width: int) -> Tensor:
    """Return the view (C, K, rows, W) of a block with gutters in which taps meet in the column they go to.

    With one number less between taps than there is, tap dx begins dx columns further left.
    """
    channels, taps, rows, pitch = buffer.shape
    strides = (taps * rows * pitch, rows * pitch - 1, pitch, 1)
    return buffer.as_strided((channels, taps, rows, width), strides, buffer.storage_offset() + taps - 1)


def _padded(image: Tensor, reach: int, height: int, value: float = 0.0) -> Tensor:
    """Return an image (C, H or H + 2 r, W) with a border of r pixels on each side."""
    rows = reach - (image.shape[-2] - height) // 2
    return F.pad(image, [reach, reach, rows, rows], value=value)
