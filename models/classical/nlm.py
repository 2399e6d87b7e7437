"""Non-local means with a variance per pixel and two buffers: plain, joint with features, multi-scale.

Fabrice Rousselle, Claude Knaus, Matthias Zwicker: "Adaptive rendering with non-local means filtering", ACM
Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214. Each half of the samples is filtered with
weights from the other half, so that the noise of weights and data is independent; the result is the mean of
both. Window radius 10, patch radius 3 and k = 0.45 are that paper's; NFOR's comparison does not name its own.

The distance is the mean of the channels' distances before the patch mean, as in the authors' code. That code
also mirrors neighbours at the border, averages the weights of neighbouring patches, drops weights below 0.05
and compares with both opposite neighbours at once; here neighbours outside the image are left out, and
weights stay as equation 3 of NFOR (`models.classical.nfor`) has them. Distances are computed on radiance
times `exposure`, since their small constant has the units of a variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import buffer
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.joint import Feature, JointKernel, joint_filter
from models.ops.nlm import Guide, PatchKernel, nlm_filter
from models.ops.pyramid import LOW_PASS, coarser, coarser_variance, finer

_COLORS = ("color_a", "color_b", "color_variance")


class NLM(Denoiser):
    """Non-local means of two half buffers.

    Args:
        window: Radius of the window.
        patch: Radius of the patches.
        bandwidth: k, how different patches may be that still count, in units of their noise.
        memory: Working memory in bytes beside the buffers; sets the height of strips.
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.
    """

    inputs: tuple[str, ...] = _COLORS
    frame_numbers = ("exposure",)

    def __init__(
        self,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        *,
        memory: int = 64_000_000,
        fused: bool | None = None,
    ) -> None:
        super().__init__()
        # The variance is that of the mean of both halves; a half has twice as much.
        self.kernel = PatchKernel(window, patch, (bandwidth,), 2.0, "mean", epsilon=1e-10)
        self.memory, self.fused = memory, fused
        self.halo = self.kernel.reach

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color_a`, `color_b` and `color_variance` (B, 3, H, W), optionally `exposure` (B,).
        """
        self.check(buffers)
        a, b, variance = (_working(buffers[name]) for name in _COLORS)
        exposure = self.exposure({**buffers, self.inputs[0]: a})
        a, b = self._halves(a * exposure, b * exposure, variance * exposure.square(), buffers)
        return Denoised(0.5 * (a + b) / exposure)

    def _halves(self, a: Tensor, b: Tensor, variance: Tensor, buffers: Buffers) -> tuple[Tensor, Tensor]:
        """Filter each half with weights of the other."""
        return (self._filter(a, Guide(b, variance)), self._filter(b, Guide(a, variance)))

    def _filter(self, image: Tensor, guide: Guide) -> Tensor:
        return nlm_filter(image[:, None], [guide], self.kernel, self.memory, fused=self.fused)[:, 0]


class JointNLM(NLM):
    """Non-local means whose weights also look at filtered features; see `models.ops.joint`.

    Features are filtered as NFOR filters them: the halves with weights from each other, their squared
    difference being the variance that is left.

    Args:
        features: Names of buffers with halves and variance.
        combine: `least`: the smallest of the colour's and the features' weights (RDFC); `product`: their
            product (equation 8 of NFOR).
        window: Radius of the window.
        patch: Radius of the colour's patches; features are compared pixel by pixel.
        bandwidth: k of the colour.
        feature_bandwidth: k of the features.
        tau: Squared difference of a feature that always counts as small; of distances, relative to the
            pixel's own value.
        prefilter_window: Radius of the window that filters the features.
        memory: Working memory in bytes beside the buffers; sets the height of strips.
        fused: As in `NLM`, for filtering the features.
    """

    def __init__(
        self,
        features: Sequence[str] = ("normal", "albedo", "depth"),
        combine: Literal["least", "product"] = "least",
        *,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        feature_bandwidth: float = 0.6,
        tau: float = 1e-3,
        prefilter_window: int = 5,
        memory: int = 64_000_000,
        fused: bool | None = None,
    ) -> None:
        super().__init__(window, patch, bandwidth, memory=memory, fused=fused)
        if combine not in ("least", "product"):
            raise ValueError(f"JointNLM: combine must be least or product, got {combine!r}")
        self.features, self.tau = tuple(features), tau
        parts = [f"{name}_{part}" for name in features for part in ("a", "b", "variance")]
        self.inputs = (*_COLORS, *parts)
        self.joint = JointKernel(self.kernel, feature_bandwidth, combine)
        self.prefilter = PatchKernel(prefilter_window, 3, (0.5,), scale=2.0)
        self.halo = window + max(patch, self.prefilter.reach + 1 if features else 0)

    def _halves(self, a: Tensor, b: Tensor, variance: Tensor, buffers: Buffers) -> tuple[Tensor, Tensor]:
        guides = [Guide(b, variance), Guide(a, variance)]
        first, second = joint_filter([a, b], guides, self._filtered(buffers), self.joint, self.memory)
        return first, second

    def _filtered(self, buffers: Buffers) -> list[Feature]:
        """Filter all features at once and return each with the variance that is left."""
        if not self.features:
            return []
        a, b, variance = (
            torch.cat([_working(buffers[f"{name}_{part}"]) for name in self.features], 1)
            for part in ("a", "b", "variance")
        )
        guide = Guide(torch.cat([b, a], 1), torch.cat([variance, variance], 1))
        halves = torch.cat([a, b], 1)[:, None]
        a, b = nlm_filter(halves, [guide], self.prefilter, self.memory, fused=self.fused)[:, 0].chunk(2, 1)
        channels = [buffer(name).channels for name in self.features]
        means, residuals = (0.5 * (a + b)).split(channels, 1), (0.25 * (b - a).square()).split(channels, 1)
        return [
            Feature.of(m, r, self.tau * m.square() if buffer(name).kind == "distance" else self.tau)
            for name, m, r in zip(self.features, means, residuals, strict=True)
        ]


class MultiScaleNLM(NLM):
    """Non-local means at several scales, against noise of low frequency.

    Mauricio Delbracio et al.: "Boosting Monte Carlo rendering by ray histogram fusion", ACM Transactions on
    Graphics 33(1), 2014, doi:10.1145/2532708: every scale is filtered by itself, then from coarse to fine
    the low frequencies are replaced, fine += up(coarse) - up(down(fine)). See `models.ops.pyramid`.

    Args:
        scales: Number of scales, 2 or 3 as a rule.
        window: Radius of the window at every scale.
        patch: Radius of the patches.
        bandwidth: k.
        memory: Working memory in bytes beside the buffers; sets the height of strips.
        fused: As in `NLM`.
    """

    def __init__(
        self,
        scales: int = 2,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        *,
        memory: int = 64_000_000,
        fused: bool | None = None,
    ) -> None:
        super().__init__(window, patch, bandwidth, memory=memory, fused=fused)
        if scales < 1:
            raise ValueError(f"MultiScaleNLM: scales must be at least 1, got {scales}")
        self.scales, self.multiple = scales, 2 ** (scales - 1)
        self.halo = self._reach(scales)

    def _reach(self, scales: int) -> int:
        """Return how far a core of `multiple` pixels looks: its filter, or through the coarser scales."""
        if scales == 1:
            return self.kernel.reach
        side = len(LOW_PASS) // 2 - 1  # down-sampling adds this, up-sampling two coarse pixels
        through = 2 * (max(self._reach(scales - 1), 0) + 2) + side
        return max(self.kernel.reach + 4 + side, through)

    def _halves(self, a: Tensor, b: Tensor, variance: Tensor, buffers: Buffers) -> tuple[Tensor, Tensor]:
        height, width = a.shape[-2:]
        step = self.multiple
        padding = (0, -width % step, 0, -height % step)
        a, b, variance = (F.pad(x, padding, mode="replicate") for x in (a, b, variance))
        a, b = self._scale(a, b, variance, self.scales)
        return a[..., :height, :width], b[..., :height, :width]

    def _scale(self, a: Tensor, b: Tensor, variance: Tensor, scales: int) -> tuple[Tensor, Tensor]:
        fine = super()._halves(a, b, variance, {})
        if scales == 1:
            return fine
        coarse = self._scale(coarser(a), coarser(b), coarser_variance(variance), scales - 1)
        first, second = (x + finer(y - coarser(x)) for x, y in zip(fine, coarse, strict=True))
        return first, second


def _working(image: Tensor) -> Tensor:
    return image if image.dtype == torch.float64 else image.float()
