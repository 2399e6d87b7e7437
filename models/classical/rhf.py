"""RHF: ray histogram fusion.

Mauricio Delbracio, Pablo Musé, Antoni Buades, Julien Chauvier, Nicholas Phelps, Jean-Michel Morel: "Boosting
Monte Carlo rendering by ray histogram fusion", ACM Transactions on Graphics 33(1), 2014, doi:10.1145/2532708.
Pixels with the same distribution of samples are averaged, so that the decision does not rest on their noisy
means: a histogram of the samples of each pixel, the chi-square distance of patches of them, a hard threshold,
and two scales against noise of low frequency. The distance and the averages are in `models.ops.histogram`,
the bins in `data.histograms`, the scales in `models.ops.pyramid`.

kappa = 0.8 is that of the released tool; NFOR's comparison takes 0.7, and the right one depends on the scene.
In the released tool the number of samples of a coarser scale is kept for the whole image, here for every
neighbourhood: the same where all pixels have equally many samples, and independent of how an image is cut.

Bins count where two pixels have more than one sample in them together. With one or two samples per pixel
hardly any do, and nearly everything is accepted. With 8 a patch that differs in one corner is still accepted,
since the few bins of one pixel are averaged with those of eight others; where that pixel is a lamp its light
spreads over the window. The distance of different patches grows with the number of samples.

Radiance and bins that are not finite count as 0; half precision is computed with in float32.
"""

from __future__ import annotations

from collections.abc import Collection

import torch.nn.functional as F
from torch import Tensor

from data.buffers import HISTOGRAM, HISTOGRAM_MADE
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.guides import finite
from models.ops.histogram import coarser_histogram, histogram_filter
from models.ops.histogram_distance import HistogramKernel
from models.ops.nlm import UNROLLED
from models.ops.pyramid import coarser, merged, reach


class RHF(Denoiser):
    """Ray histogram fusion.

    Args:
        scales: Number of scales, 2 or 3 as a rule.
        window: Radius of the window at every scale.
        patch: Radius of the patches.
        threshold: kappa, the distance below which patches are averaged: smaller keeps more detail and noise.
        nearest: How many of the nearest patches are averaged at the finest scale whatever their distance,
            beside the patch itself.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: Whether compiled loops take over, None: where possible; see `models.ops.nlm.use_fused`.
    """

    inputs = ("color", HISTOGRAM)
    no_export = UNROLLED
    bytes_per_pixel = 1400
    bytes_once = 64_000_000

    def __init__(
        self,
        scales: int = 2,
        window: int = 6,
        patch: int = 1,
        threshold: float = 0.8,
        *,
        nearest: int = 2,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        super().__init__()
        if scales < 1:
            raise ValueError(f"RHF: scales must be at least 1, got {scales}")
        self.kernel = HistogramKernel(window, patch, threshold, nearest)
        self.coarse_kernel = HistogramKernel(window, patch, threshold, 0)
        self.scales, self.multiple = scales, 2 ** (scales - 1)
        self.memory, self.fused = memory, fused
        self.halo = reach(self.kernel.reach, scales)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color` (B, 3, H, W) and `histogram` (B, 60, H, W).
        """
        _, height, width = self.check(buffers)
        step = self.multiple
        padding = (0, -width % step, 0, -height % step)
        color, histogram = (F.pad(finite(buffers[name]), padding, mode="replicate") for name in self.inputs)
        result = self._scale(color, histogram, self.scales, self.kernel)
        return Denoised(result[..., :height, :width])

    def made_by(self, missing: Collection[str]) -> str:
        """Say where histograms come from."""
        return HISTOGRAM_MADE if HISTOGRAM in missing else ""

    def _scale(self, color: Tensor, histogram: Tensor, scales: int, kernel: HistogramKernel) -> Tensor:
        fine = histogram_filter(color, histogram, kernel, self.memory, fused=self.fused)
        if scales == 1:
            return fine
        smaller = coarser(color), coarser_histogram(histogram)
        return merged(fine, self._scale(*smaller, scales - 1, self.coarse_kernel))
