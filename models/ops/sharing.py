"""Weight-sharing kernel construction and filtering (WSKP): log-importance maps in, filtered image out.

With E = exp(log-importance), a window of k x k pixels around p, cut at the image border, gives

    R_k(p) = sum_q E(q) I(q) / sum_q E(q),        output(p) = sum_k softmax(fusion)_k(p) R_k(p)

(Fan et al. 2021, doi:10.1111/cgf.14338, equations 2 to 5). `reconstruct_by_softmax` computes it as written,
with k x k weights per pixel, and is the reference. `reconstruct` uses that R_k is a ratio of two window
sums: no weight is ever stored and the running time hardly depends on k.

Numbers: `models.ops.window` sums exp for maps of any range; images are processed in chunks of samples and
of rows that fit the processor's cache, which also keeps the extra memory small.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import box_sum, box_sums_exported, exporting
from models.ops.window import log_maps, to_band, window_sums

EXPORTED_SPAN = 128.0
"""Range of log-importance below the maximum that an exported graph distinguishes: see `reconstruct`."""

_CHUNK = 1 << 16
"""Pixels processed at once on a CPU: four channels of them fit a core's second-level cache."""


def reconstruct(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Filter an image with the kernels that the importance maps encode, and fuse the results.

    Exact for every finite log-importance, borders included (windows are cut at the image and renormalised).
    Runs in float32, or float64 for float64 input, also under mixed precision. Differentiable once, with
    respect to all three tensors; the backward pass recomputes the window sums instead of keeping them.

    A graph recorded by torch.jit.trace or torch.export cannot choose the number of bands. It raises
    log-importance more than `EXPORTED_SPAN` below the largest value of its map to that level: a window that
    holds higher pixels weighs such pixels under 1e-55 of the map's largest either way, a window that holds
    nothing else averages them equally, and the result is always finite.

    Args:
        irradiance: (B, 3, H, W), linear.
        log_importance: (B, K, H, W), one map per kernel.
        fusion_logits: (B, K, H, W), softmax over K gives the fusion weights.
        kernel_sizes: K odd window sizes.

    Returns:
        (B, 3, H, W), filtered irradiance.

    Raises:
        ValueError: Number of maps and kernels differ, or a size is even.
    """
    if not exporting():
        _check(log_importance, fusion_logits, kernel_sizes)
    irradiance, log_importance, fusion_logits = _wide(irradiance), _wide(log_importance), _wide(fusion_logits)
    if exporting():
        return _reconstruct_exported(irradiance, log_importance, fusion_logits, kernel_sizes)
    fusion = torch.softmax(fusion_logits, 1)
    needs_gradient = any(t.requires_grad for t in (irradiance, log_importance, fusion))
    if torch.is_grad_enabled() and needs_gradient:
        result: Tensor = _Reconstruct.apply(irradiance, log_importance, fusion, tuple(kernel_sizes))
        return result
    return _forward(irradiance, log_importance, fusion, kernel_sizes)


def reconstruct_by_softmax(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Compute what `reconstruct` computes, as the paper writes it: unfold, softmax per window, weighted sum.

    The reference: arguments, result and errors are those of `reconstruct`. Needs 4 k**2 values per pixel.
    """
    _check(log_importance, fusion_logits, kernel_sizes)
    irradiance, log_importance = _wide(irradiance), _wide(log_importance)
    fusion = torch.softmax(_wide(fusion_logits), 1)
    batch, channels, height, width = irradiance.shape
    total = torch.zeros_like(irradiance)
    for index, size in enumerate(kernel_sizes):
        padding = [size // 2] * 4
        logits = F.pad(log_importance[:, index : index + 1], padding, value=float("-inf"))
        weights = torch.softmax(F.unfold(logits, size), 1)
        values = F.unfold(F.pad(irradiance, padding), size).reshape(batch, channels, size * size, -1)
        filtered = (values * weights[:, None]).sum(2).reshape(batch, channels, height, width)
        total = total + fusion[:, index : index + 1] * filtered
    return total


def _check(log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]) -> None:
    maps = (log_importance.shape[1], fusion_logits.shape[1])
    if maps != (len(kernel_sizes), len(kernel_sizes)):
        raise ValueError(
            f"{len(kernel_sizes)} kernel sizes need as many importance maps and fusion logits, got "
            f"{maps[0]} and {maps[1]}"
        )
    if any(size < 1 or size % 2 == 0 for size in kernel_sizes):
        raise ValueError(f"kernel sizes must be odd and positive, got {tuple(kernel_sizes)}")


def _wide(tensor: Tensor) -> Tensor:
    return tensor if tensor.dtype == torch.float64 else tensor.float()


def _chunks(batch: int, pixels: int, like: Tensor) -> Iterator[slice]:
    """Return groups of samples that are processed at once; devices other than the CPU take them all."""
    step = max(1, _CHUNK // pixels) if like.device.type == "cpu" else batch
    return (slice(first, min(batch, first + step)) for first in range(0, batch, step))


def _forward(
    irradiance: Tensor, log_importance: Tensor, fusion: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Stream over samples, rows and kernels: one small set of window sums is alive at a time."""
    batch, _, height, width = irradiance.shape
    total = torch.zeros_like(irradiance)
    for some in _chunks(batch, height * width, irradiance):
        noisy, maps = irradiance[some], log_maps(log_importance[some])
        rows = max(16, _CHUNK // (noisy.shape[0] * width)) if irradiance.device.type == "cpu" else height
        for start in range(0, height, rows):
            stop = min(height, start + rows)
            part, shares = total[some, :, start:stop], fusion[some, :, start:stop]
            for index, (size, log_map) in enumerate(zip(kernel_sizes, maps, strict=True)):
                sums = window_sums(noisy, log_map, size, start, stop).sums
                part.addcmul_(sums[:, :3], shares[:, index : index + 1] / sums[:, 3:])
    return total


class _Reconstruct(torch.autograd.Function):
    """`_forward` with a backward pass that keeps only the inputs.

    A window is symmetric, so the adjoint of a window sum B is B. With D = B(E), h = a g / D for the
    incoming gradient g and fusion weight a, summed over colour channels c:

        dL/da = sum_c g_c R_c,    dL/dI_c = E B(h_c),
        dL/d(log-importance) = E sum_c (I_c B(h_c) - B(h_c R_c))
    """

    @staticmethod
    def forward(
        ctx: Any, irradiance: Tensor, log_importance: Tensor, fusion: Tensor, sizes: tuple[int, ...]
    ) -> Tensor:
        ctx.save_for_backward(irradiance, log_importance, fusion)
        ctx.sizes = sizes
        return _forward(irradiance, log_importance, fusion, sizes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        irradiance, log_importance, fusion = ctx.saved_tensors
        batch, _, height, width = irradiance.shape
        d_irradiance = torch.zeros_like(irradiance) if ctx.needs_input_grad[0] else None
        d_log, d_fusion = torch.zeros_like(log_importance), torch.empty_like(fusion)
        for some in _chunks(batch, height * width, irradiance):
            noisy, maps = irradiance[some], log_maps(log_importance[some])
            d_noisy = None if d_irradiance is None else d_irradiance[some]
            for index, (size, log_map) in enumerate(zip(ctx.sizes, maps, strict=True)):
                one = slice(index, index + 1)
                sums, highest = window_sums(noisy, log_map, size, 0, height)
                inverse = sums[:, 3:].reciprocal()
                sums[:, :3].mul_(inverse).mul_(gradient[some])
                torch.sum(sums[:, :3], 1, keepdim=True, out=d_fusion[some, one])
                adjoint = torch.cat([gradient[some], d_fusion[some, one]], 1)
                adjoint.mul_(inverse.mul_(fusion[some, one]))
                for band in log_map.bands:
                    energy = log_map.energy(band, slice(0, height))
                    spread = box_sum(to_band(adjoint, highest, band), size).mul_(energy)
                    if d_noisy is not None:
                        d_noisy += spread[:, :3]
                    spread[:, :3].mul_(noisy)
                    d_log[some, one] += spread[:, :3].sum(1, keepdim=True).sub_(spread[:, 3:])
        return d_irradiance, d_log, d_fusion, None


def _reconstruct_exported(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """The same without branches on data and writes in place, for graphs that other runtimes execute.

    Without a backward pass one band of 128 fits float32: e**60 for the largest importance times radiance
    up to 1e9 and e**-68 for the smallest times radiance down to 1e-7. Softmax over channels is written out:
    ONNX Runtime transposes the image for it.
    """
    depth = log_importance.amax((-2, -1), keepdim=True) - log_importance
    depth = depth.clamp(max=EXPORTED_SPAN)
    # Whole numbers, and small where the range is: then exponents are rounded finely.
    half = (depth.amax((-2, -1), keepdim=True) / 2).floor().clamp(max=60.0)
    energy = torch.exp(half - depth)
    maps = [energy[:, index : index + 1] for index in range(len(kernel_sizes))]
    sums = box_sums_exported([torch.cat([irradiance * e, e], 1) for e in maps], kernel_sizes, 4)
    shares = torch.exp(fusion_logits - fusion_logits.amax(1, keepdim=True))
    total = torch.zeros_like(irradiance)
    for index, window in enumerate(sums):
        total = total + window[:, :3] * (shares[:, index : index + 1] / window[:, 3:])
    return total / shares.sum(1, keepdim=True)
