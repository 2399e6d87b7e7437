"""Averages of patches whose ray histograms are alike, one window offset at a time.

Mauricio Delbracio et al.: "Boosting Monte Carlo rendering by ray histogram fusion", ACM Transactions on
Graphics 33(1), 2014, doi:10.1145/2532708. With the histogram h of a pixel's samples and their number n, the
distance of two patches is the mean over their pixels, over colour channels and bins of

    (n_q h_p - n_p h_q)^2 / (n_p n_q (h_p + h_q)) = n_p n_q (h_p / n_p - h_q / n_q)^2 / (h_p + h_q)

where bins with h_p + h_q <= 1, and pixels without samples, do not count. Patches nearer than a threshold are
accepted, with equal weights, and so are a number of nearest ones and the patch itself. The mean of the
accepted patches is an estimate of the whole patch; a pixel is the mean of the estimates of all patches that
it lies in.

At the border patches shrink: the radius of the patch around a pixel is at most its distance from the border,
and neighbours are those whose patch of that radius lies in the image.

Everything works on whole images per offset. What pixels contribute is one image per offset, whose box sums
are the distances of all patches; an offset and its opposite share it. On the CPU it is made by compiled loops
where Numba is installed (`models.ops.fused`). The second sweep spreads 1 / (number of accepted patches) over
each patch, and so has the weight of a pixel's neighbour at that offset. The centre counts like any other
offset, so constant images stay constant.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import HISTOGRAM_BINS
from models.ops.boxes import box_sum_valid, exporting
from models.ops.histogram_distance import HistogramKernel, HistogramPatches
from models.ops.nlm import strips, use_fused
from models.ops.pyramid import coarser
from models.pace import tick


def coarser_histogram(histogram: Tensor) -> Tensor:
    """Return the histograms (B, C, H / 2, W / 2) of patches twice as large, with four times the samples.

    The low pass of `models.ops.pyramid` times 4: where all patches have equally many samples, the image keeps
    their number.
    """
    return torch.cat([4 * coarser(part) for part in histogram.split(HISTOGRAM_BINS, 1)], 1)


def histogram_filter(
    image: Tensor,
    histogram: Tensor,
    kernel: HistogramKernel,
    budget: float | None = None,
    *,
    fused: bool | None = None,
) -> Tensor:
    """Filter an image with patches that are alike in their histograms.

    Args:
        image: (B, C, H, W).
        histogram: (B, 60, H, W); it gets no gradient, since patches are accepted or not.
        kernel: How patches are compared.
        budget: Working memory in bytes, which sets the height of the strips that are worked on; see
            `models.ops.nlm.strips`.
        fused: See `models.ops.nlm.use_fused`.

    Returns:
        (B, C, H, W).
    """
    batch, height, width = image.shape[0], *image.shape[-2:]
    with torch.no_grad():
        patches = HistogramPatches(histogram.detach(), kernel, use_fused(fused, histogram.detach()))
    padded = F.pad(image, [kernel.window] * 4)
    planes = 4 * histogram.shape[1] + 2 * len(kernel.offsets) + 4 * image.shape[1]
    row_bytes = image.element_size() * batch * planes * width
    result = []
    for rows in [(0, height)] if exporting() else strips(height, row_bytes, budget, image.device):
        with torch.no_grad():
            accepted = patches.accepted(rows)
        result.append(_fused(padded, patches, accepted, rows))
        tick((rows[1] - rows[0]) / height)
    return result[0] if len(result) == 1 else torch.cat(result, -2)


def _fused(image: Tensor, patches: HistogramPatches, accepted: list[Tensor], rows: tuple[int, int]) -> Tensor:
    """Return rows of the mean of all estimates; image: padded by the radius of the window."""
    kernel, (start, stop) = patches.kernel, rows
    radius, width = patches.radius(rows), patches.size[1]
    share = torch.stack(accepted).sum(0).clamp_min(1).to(image.dtype).reciprocal()
    total: Tensor | None = None
    norm: Tensor | None = None
    for mask, (down, right) in zip(accepted, kernel.offsets, strict=True):
        weight = _spread(torch.where(mask, share, 0.0), radius, kernel.patch)
        top, left = kernel.window + down, kernel.window + right
        q = image[..., top + start : top + stop, left : left + width]
        total = weight * q if total is None else torch.addcmul(total, weight, q)
        norm = weight if norm is None else norm + weight
    assert total is not None
    assert norm is not None
    return total / norm


def _spread(weight: Tensor, radius: Tensor, patch: int) -> Tensor:
    """Spread the weight of each patch over its patches: (B, 1, h + 2 F, W) to (B, 1, h, W)."""
    result: Tensor | None = None
    for size in range(patch + 1):
        margin = patch - size
        part = torch.where(radius == size, weight, 0.0)
        part = part[..., margin : part.shape[-2] - margin, :]
        part = box_sum_valid(F.pad(part, (size, size, 0, 0)), 2 * size + 1)
        result = part if result is None else result + part
    assert result is not None
    return result
