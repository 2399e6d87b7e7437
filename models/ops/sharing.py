"""Weight-sharing kernel construction and filtering (WSKP): log-importance maps in, filtered image out.

With E = exp(log-importance), a window of k x k pixels around p, cut at the image border, gives

    R_k(p) = sum_q E(q) I(q) / sum_q E(q),        output(p) = sum_k softmax(fusion)_k(p) R_k(p)

(Fan et al. 2021, doi:10.1111/cgf.14338, equations 2 to 5). `reconstruct_by_softmax` computes it as written,
with k x k weights per pixel, and is the reference. `reconstruct` uses that R_k is a ratio of two window
sums: no weight is ever stored and the running time hardly depends on k.

Numbers: exp overflows above 88 and one common shift underflows whole windows to 0 / 0 as soon as a map
spans more than about 90, while a shift per window cannot be shared by window sums. So log-importance is cut
into bands of 64, measured down from the largest value of each map. Within a band exp stays in e**-32 …
e**32; every band gets window sums of its own, and a pixel combines them relative to the highest band that
its window holds. That equals the softmax for every finite input. A map that spans less than 64, the
common case, has one band and costs nothing extra; bands without pixels are skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from models.ops.boxes import box_mean_padded, box_sum, exporting

SPAN = 64.0
"""Width of a band of log-importance: e**(+-32) times radiance up to 1e9 and 169 pixels stays in float32."""

EXPORTED_BANDS = 2
"""Bands of an exported graph, which cannot choose: see `reconstruct`."""


class Window(NamedTuple):
    """Window sums of one map: numerators and denominator (B, 4, H, W), relative to exp(-SPAN * band)."""

    sums: Tensor
    band: Tensor | None


def reconstruct(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Filter an image with the kernels that the importance maps encode, and fuse the results.

    Exact for every finite log-importance, borders included (windows are cut at the image and renormalised).
    Runs in float32, or float64 for float64 input, also under mixed precision. Differentiable once, with
    respect to all three tensors; the backward pass recomputes the window sums instead of keeping them.

    In a graph recorded by torch.jit.trace or torch.export the number of bands is fixed to
    `EXPORTED_BANDS`: log-importance more than 128 below the largest value of its map is raised to that
    level (such pixels weigh under 1e-55 of the brightest; only windows that hold nothing else notice: they
    average equally), so that the result is always finite.

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
    _check(log_importance, fusion_logits, kernel_sizes)
    irradiance, log_importance = _wide(irradiance), _wide(log_importance)
    fusion = torch.softmax(_wide(fusion_logits), 1)
    if exporting():
        return _reconstruct_exported(irradiance, log_importance, fusion, kernel_sizes)
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


def _tops(log_importance: Tensor) -> Tensor:
    """Return the reference level of every map (B, K, 1, 1): its maximum, rounded up.

    Whole numbers keep `top - SPAN * band` free of rounding for maps of any height.
    """
    return log_importance.detach().amax((-2, -1), keepdim=True).ceil()


def _bands(log_importance: Tensor, tops: Tensor) -> list[list[int]]:
    """Return for each of the K maps the bands, counted down from the top, that hold at least one pixel."""
    depth = tops - log_importance.detach().amin((-2, -1), keepdim=True)
    deepest = depth.amax((0, 2, 3)).tolist()
    result = []
    for index, deep in enumerate(deepest):
        if deep < SPAN:
            result.append([0])
            continue
        level = ((tops[:, index] - log_importance.detach()[:, index]) / SPAN).floor()
        result.append([int(b) for b in torch.unique(level).tolist()])
    return result


def _energy(log_map: Tensor, top: Tensor, band: int, alone: bool) -> Tensor:
    """Return exp(log-importance) of the pixels of one band, relative to its centre, 0 elsewhere."""
    shifted = log_map - (top - SPAN * (band + 0.5))
    if alone:
        return shifted.exp_()
    inside = ((top - log_map) / SPAN).floor_() == band
    return torch.where(inside, shifted.clamp_(-SPAN, SPAN).exp_(), 0.0)


def _weighted(energy: Tensor, irradiance: Tensor) -> Tensor:
    batch, _, height, width = irradiance.shape
    stacked = irradiance.new_empty(batch, 4, height, width)
    torch.mul(irradiance, energy, out=stacked[:, :3])
    stacked[:, 3:] = energy
    return stacked


def _window(irradiance: Tensor, log_map: Tensor, top: Tensor, bands: list[int], size: int) -> Window:
    """Return the window sums of one map."""
    first, *lower = bands
    energy = _energy(log_map, top, first, alone=not lower)
    sums = box_sum(_weighted(energy, irradiance), size)
    if not lower:
        return Window(sums, None)
    highest = torch.full_like(log_map, first)
    for band in lower:
        energy = _energy(log_map, top, band, alone=False)
        below = box_sum(_weighted(energy, irradiance), size)
        empty = sums[:, 3:] == 0
        sums = sums + below * torch.where(empty, 1.0, torch.exp(SPAN * (highest - band)))
        highest = torch.where(empty, float(band), highest)
    return Window(sums, highest)


def _forward(
    irradiance: Tensor, log_importance: Tensor, fusion: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """Stream over the kernels: one set of window sums is alive at a time."""
    tops = _tops(log_importance)
    total = torch.zeros_like(irradiance)
    for index, (size, bands) in enumerate(zip(kernel_sizes, _bands(log_importance, tops), strict=True)):
        one = slice(index, index + 1)
        sums = _window(irradiance, log_importance[:, one], tops[:, one], bands, size).sums
        total.addcmul_(sums[:, :3], fusion[:, one] / sums[:, 3:])
    return total


class _Reconstruct(torch.autograd.Function):
    """`_forward` with a backward pass that keeps only its inputs.

    A window is symmetric, so the adjoint of a window sum B is B. With D = B(E), h = a g / D for the
    incoming gradient g and fusion weight a, summed over colour channels c:

        dL/da = sum_c g_c R_c,    dL/dI_c = E B(h_c),
        dL/d(log-importance) = E sum_c (I_c B(h_c) - B(h_c R_c))
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx, irradiance: Tensor, log_importance: Tensor, fusion: Tensor, sizes: tuple[int, ...]
    ) -> Tensor:
        ctx.save_for_backward(irradiance, log_importance, fusion)
        ctx.sizes = sizes  # type: ignore[attr-defined]
        return _forward(irradiance, log_importance, fusion, sizes)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[no-untyped-def]
        irradiance, log_importance, fusion = ctx.saved_tensors
        tops = _tops(log_importance)
        d_irradiance = torch.zeros_like(irradiance) if ctx.needs_input_grad[0] else None
        d_log, d_fusion = torch.empty_like(log_importance), torch.empty_like(fusion)
        for index, (size, bands) in enumerate(zip(ctx.sizes, _bands(log_importance, tops), strict=True)):
            one = slice(index, index + 1)
            log_map, top = log_importance[:, one], tops[:, one]
            sums, highest = _window(irradiance, log_map, top, bands, size)
            inverse = sums[:, 3:].reciprocal()
            filtered = sums[:, :3] * inverse
            d_fusion[:, one] = (gradient * filtered).sum(1, keepdim=True)
            adjoint = torch.cat([gradient, d_fusion[:, one]], 1) * (fusion[:, one] * inverse)
            d_log[:, one] = 0
            for band in bands:
                energy = _energy(log_map, top, band, alone=highest is None)
                spread = box_sum(_to_band(adjoint, highest, band), size)
                pull = (irradiance * spread[:, :3]).sum(1, keepdim=True) - spread[:, 3:]
                d_log[:, one] += energy * pull
                if d_irradiance is not None:
                    d_irradiance.addcmul_(energy.expand_as(irradiance), spread[:, :3])
        return d_irradiance, d_log, d_fusion, None


def _to_band(adjoint: Tensor, highest: Tensor | None, band: int) -> Tensor:
    """Scale 1 / D from the highest band of each window to `band`; 0 where the window holds no such pixel."""
    if highest is None:
        return adjoint
    scale = torch.exp((SPAN * (highest - band)).clamp_max(0.0))
    return adjoint * torch.where(highest <= band, scale, 0.0)


def _reconstruct_exported(
    irradiance: Tensor, log_importance: Tensor, fusion: Tensor, kernel_sizes: Sequence[int]
) -> Tensor:
    """The same without branches on data and writes in place, for graphs that other runtimes execute."""
    top = log_importance.amax((-2, -1), keepdim=True)
    depth = (top - log_importance).clamp(max=SPAN * EXPORTED_BANDS)
    upper = depth < SPAN
    high = torch.where(upper, torch.exp(SPAN / 2 - depth), 0.0)
    low = torch.where(upper, 0.0, torch.exp(SPAN * 1.5 - depth))
    total = torch.zeros_like(irradiance)
    for index, size in enumerate(kernel_sizes):
        one = slice(index, index + 1)
        above = box_mean_padded(torch.cat([irradiance * high[:, one], high[:, one]], 1), size)
        below = box_mean_padded(torch.cat([irradiance * low[:, one], low[:, one]], 1), size)
        scale = torch.where(above[:, 3:] > 0, float(torch.exp(torch.tensor(-SPAN))), 1.0)
        sums = above + below * scale
        total = total + fusion[:, one] * (sums[:, :3] / sums[:, 3:])
    return total
