"""Non-local means with a variance per pixel and two buffers: plain and multi-scale.

Fabrice Rousselle, Claude Knaus, Matthias Zwicker: "Adaptive rendering with non-local means filtering", ACM
Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214 (RKZ12). Each half of the samples is
filtered with weights from the other half, so that the noise of weights and data is independent; the result is
the mean of both. Window radius 10, patch radius 3 and k = 0.45 are that paper's; NFOR's comparison does not
name its own. The distance is the mean of the channels' distances before the patch mean, as in RKZ12's code.

Preset `rkz12` does what that code does beyond the paper's equations (`models.ops.symmetric`): it compares
opposite neighbours together, averages weights over the patch, drops those below 0.05, and mirrors the border.
Preset `plain` leaves neighbours outside the image out and keeps the weights as equation 3 of NFOR
(`models.classical.nfor`) has them. `plain` is the default for its speed: it has a compiled kernel and takes a
fortieth of the time of `rkz12`. That one is better: on crops of 128x128 of 23 stills at 32 samples per pixel
the geometric mean of relMSE (epsilon 0.01) is 0.0461 and that of `plain` 0.0498 (input 0.1813), the mean PSNR
(exposed, gamma 2.2) 25.78 and 25.51 dB (input 21.78); on 3 of 23 it is worse.

Distances are computed on radiance times `exposure`, since their small constant has the units of a variance.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal, get_args

import torch.nn.functional as F
from torch import Tensor

from models.denoiser import Buffers, Denoised, Denoiser
from models.ops import halves
from models.ops.fireflies import KEPT, Fireflies, checked, limited_halves
from models.ops.halves import ColorNoise, Halves
from models.ops.nlm import UNROLLED, Guide, PatchKernel, nlm_filter
from models.ops.pyramid import coarser, coarser_variance, merged, reach
from models.ops.symmetric import SymmetricKernel, residual_error, scaled_variance, symmetric_filter

Preset = Literal["plain", "rkz12"]
Sampling = Literal["random", "low-discrepancy"]

_SAMPLED = 10
"""Radius over which the variance of low-discrepancy samples is compared with the difference of the halves."""


class NLM(Denoiser):
    """Non-local means of two half buffers.

    Args:
        window: Radius of the window.
        patch: Radius of the patches.
        bandwidth: k, how different patches may be that still count, in units of their noise.
        preset: `plain` is fast, `rkz12` does what that paper's code does: better, at forty times the time.
        symmetric: Preset `rkz12`: compare opposite neighbours together.
        smoothing: Preset `rkz12`: radius of the box that averages weights, 0: none, None: as the patch.
        least_weight: Preset `rkz12`: smaller weights are dropped.
        color_noise: Where halves and variance of the colour come from: `measured` reads all three, `halves`
            takes the variance from the difference of both halves, `variance` reads the mean and its variance,
            `estimated` the image alone (`models.ops.halves`).
        sampling: `low-discrepancy` scales the measured variance, which is too large then, by what the halves
            say; see `models.ops.symmetric.scaled_variance`.
        fireflies: `keep` them, or `limit` the halves of the colour by each other before anything else, see
            `models.ops.fireflies`; needs two halves.
        aux: Also return `residual`, (B, 1, H, W), see `models.ops.symmetric.residual_error`.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.
            Preset `rkz12` has none.
    """

    frame_numbers = ("exposure",)
    no_export = UNROLLED

    def __init__(
        self,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        *,
        preset: Preset = "plain",
        symmetric: bool = True,
        smoothing: int | None = None,
        least_weight: float = 0.05,
        color_noise: ColorNoise = "measured",
        sampling: Sampling = "random",
        fireflies: Fireflies = "keep",
        aux: bool = False,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        self._arguments = arguments
        name = type(self).__name__
        for option, given, allowed in (
            ("preset", preset, get_args(Preset)),
            ("sampling", sampling, get_args(Sampling)),
        ):
            if given not in allowed:
                raise ValueError(f"{name}: {option} must be {' or '.join(allowed)}, got {given!r}")
        halves.checked(f"{name}: color_noise", color_noise, get_args(ColorNoise))
        if sampling != "random" and color_noise != "measured":
            raise ValueError(
                f"{name}: sampling={sampling} corrects a measured variance, not color_noise={color_noise}; "
                "color_noise=halves needs no correction"
            )
        # The variance is that of the mean of both halves; a half has twice as much.
        self.kernel = PatchKernel(window, patch, (bandwidth,), 2.0, "mean", epsilon=1e-10)
        smooth = patch if smoothing is None else smoothing
        self.rkz12 = (
            SymmetricKernel(self.kernel, symmetric, smooth, least_weight) if preset == "rkz12" else None
        )
        self.fireflies = checked(name, fireflies, color_noise)
        self.color_noise, self.sampling, self.aux, self.memory = color_noise, sampling, aux, memory
        self.fused = fused if preset == "plain" else False  # there are no compiled kernels for the other
        self.inputs = halves.inputs("color", color_noise)
        self.halo = self._filter_reach() + self._color_reach()

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color_a`, `color_b` and `color_variance` (B, 3, H, W) unless `color_noise` says
                otherwise; optionally `exposure` (B,).
        """
        self.check(buffers)
        color = halves.halves(buffers, "color", self.color_noise)
        exposure = self.exposure({**buffers, self.inputs[0]: color.a})
        color = Halves(color.a * exposure, color.b * exposure, color.variance * exposure.square())
        if self.sampling == "low-discrepancy":
            color = color._replace(variance=scaled_variance(color.variance, color.a, color.b, _SAMPLED))
        if self.fireflies == "limit":
            color = limited_halves(color)
        a, b, features = self._halves(color, buffers)
        aux = {"residual": residual_error(a, b), **features} if self.aux else None
        return Denoised(0.5 * (a + b) / exposure, aux=aux)

    def check(self, buffers: Buffers) -> tuple[int, int, int]:
        """Check names and shapes; where halves or variances are missing say which options do without."""
        try:
            return super().check(buffers)
        except ValueError as error:
            if all(name in buffers for name in self.inputs):
                raise
            raise ValueError(f"{error}. {self._without()}") from None

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return this method with the noise options that the buffers allow; see `Denoiser.instead`."""
        changed, reasons = self._possible(available)
        if not changed:
            return None
        other = type(self)(**{**self._arguments, **changed})
        return (other, reasons) if set(other.inputs) <= set(available) else None

    def _possible(self, available: Collection[str]) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Return the options to change and the reasons."""
        found = halves.possible("color", self.color_noise, available)
        if found is None:
            return {}, ()
        noise, reason = found
        changed = {"color_noise": noise, "sampling": "random"}
        if not halves.independent(noise):
            if self.sampling == "low-discrepancy":
                reason += "; its variance is that of random samples, too large for these"
            if self.fireflies == "limit":
                reason += KEPT
                changed["fireflies"] = "keep"
        return changed, (reason,)

    def _without(self) -> str:
        return "color_noise=estimated needs color alone"

    def _filter_reach(self) -> int:
        """How far a filtered half looks."""
        return self.kernel.reach if self.rkz12 is None else self.rkz12.reach

    def _color_reach(self) -> int:
        """How far the halves and their variance look."""
        sampled = _SAMPLED if self.sampling == "low-discrepancy" else 0
        return halves.reach(self.color_noise) + sampled + (self.fireflies == "limit")

    def _halves(self, color: Halves, buffers: Buffers) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Filter both halves; return them and what else `aux` may name."""
        return *self._crossed(color), {}

    def _crossed(self, color: Halves) -> tuple[Tensor, Tensor]:
        """Filter each half with weights of the other; a buffer that stands for both only once."""
        first = self._filter(color.a, Guide(color.b, color.variance))
        if not halves.independent(self.color_noise):
            return first, first
        return first, self._filter(color.b, Guide(color.a, color.variance))

    def _filter(self, image: Tensor, guide: Guide) -> Tensor:
        if self.rkz12 is not None:
            return symmetric_filter(image, guide, self.rkz12, self.memory)
        return nlm_filter(image[:, None], [guide], self.kernel, self.memory, fused=self.fused)[:, 0]


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
        preset: As in `NLM`, with the defaults of its options.
        color_noise: As in `NLM`.
        sampling: As in `NLM`.
        fireflies: As in `NLM`.
        aux: As in `NLM`.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: As in `NLM`.
    """

    def __init__(
        self,
        scales: int = 2,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        *,
        preset: Preset = "plain",
        color_noise: ColorNoise = "measured",
        sampling: Sampling = "random",
        fireflies: Fireflies = "keep",
        aux: bool = False,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__(
            window,
            patch,
            bandwidth,
            preset=preset,
            color_noise=color_noise,
            sampling=sampling,
            fireflies=fireflies,
            aux=aux,
            memory=memory,
            fused=fused,
        )
        self._arguments = arguments
        if scales < 1:
            raise ValueError(f"MultiScaleNLM: scales must be at least 1, got {scales}")
        self.scales, self.multiple = scales, 2 ** (scales - 1)
        self.halo = reach(self._filter_reach(), scales) + self._color_reach()

    def _halves(self, color: Halves, buffers: Buffers) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        height, width = color.a.shape[-2:]
        step = self.multiple
        padding = (0, -width % step, 0, -height % step)
        padded = Halves(*(F.pad(x, padding, mode="replicate") for x in color))
        a, b = self._scale(padded, self.scales)
        return a[..., :height, :width], b[..., :height, :width], {}

    def _scale(self, color: Halves, scales: int) -> tuple[Tensor, Tensor]:
        fine = self._crossed(color)
        if scales == 1:
            return fine
        smaller = Halves(coarser(color.a), coarser(color.b), coarser_variance(color.variance))
        coarse = self._scale(smaller, scales - 1)
        first, second = (merged(x, y) for x, y in zip(fine, coarse, strict=True))
        return first, second
