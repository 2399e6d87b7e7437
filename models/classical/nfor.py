"""NFOR: nonlinearly weighted first-order regression, a denoiser without training.

Benedikt Bitterli, Fabrice Rousselle, Bochang Moon, José A. Iglesias-Guitián, David Adler, Kenny Mitchell,
Wojciech Jarosz, Jan Novák: "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo
Renderings", Computer Graphics Forum 35(4), 2016, doi:10.1111/cgf.12954.

Features are filtered; each half of the colour is fitted, window by window, by a linear model of position and
features of the other half, with non-local means weights of the other half, for two bandwidths; an estimate of
the error of each bandwidth selects between them, pixel by pixel; the mean of both halves is fitted once more.

Preset `public` does what the authors' public implementation (in the Tungsten renderer) does, preset `paper`
what the paper says where that differs:

    point                     public                            paper
    filtered features         second step before the last       second step for the halves too, weights
                              regression only                   from the other half
    variance in the last      that of the mean, times 2         that of the mean
    regression

Two differences make none here. The paper scales features to [-1, 1] per window, which changes nothing but
the conditioning; `models.ops.regression` solves independently of units. The paper filters one selection map
per bandwidth; filtered with the same normalised weights they add up to 1, so the map of k = 1 and its
complement are the same. The public implementation solves by a pivoted QR factorisation in float32, this one
by normal equations with a ridge of 1e-6. Distances are computed on radiance times `exposure`, since their
small constant (1e-7) has the units of a variance; where no exposure is given that is the public behaviour.

Published: best mean and least spread of MSE, relative MSE, PSNR and SSIM over 21 scenes (figure 10), 223 s
and 3.2 GB per image (table 2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from data.buffers import buffer
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.nlm import Guide, PatchKernel, nlm_filter
from models.ops.regression import Sample, collaborative_regression

BANDWIDTHS = (0.5, 1.0)
"""Candidates for k, section 5.3."""


class Details(NamedTuple):
    """What NFOR knows beside the image; every tensor has the leading axes of the input.

    Attributes:
        color: Filtered radiance (B, 3, H, W).
        errors: Estimated and filtered mean squared error of each bandwidth, (B, 3, H, W) in squared units of
            the input; may be negative.
        selection: Share of the larger bandwidth, (B, 3, H, W) in [0, 1].
        features: Filtered features by name, as the last regression uses them.
    """

    color: Tensor
    errors: tuple[Tensor, Tensor]
    selection: Tensor
    features: dict[str, Tensor]


class _Colors(NamedTuple):
    """Halves of the colour and the variance of their mean, (B, T, 3, H, W)."""

    a: Tensor
    b: Tensor
    variance: Tensor

    @property
    def mean(self) -> Tensor:
        return 0.5 * (self.a + self.b)


class _Features(NamedTuple):
    """Filtered halves of the features for the first regressions, and what the last one uses."""

    a: Tensor
    b: Tensor
    final: Tensor


class NFOR(Denoiser):
    """NFOR; reads two half buffers and the variance of their mean, of the colour and of every feature.

    Images, or sequences (B, T, C, H, W) where `frames` is not 0: then windows span frames, the frame index
    is a feature, and the result is the middle frame (`sequence` returns all).

    Args:
        preset: `public` or `paper`, see above.
        features: Names of the buffers that the regression uses, any subset of the vocabulary; may be empty.
        frames: Frames before and after a pixel's own that its window spans; the paper uses 2.
        window: Radius of the regression window and of the windows that filter maps.
        patch: Radius of the patches.
        prefilter_window: Radius of the window that filters the features' halves.
        final_window: Radius of the window that filters features once more.
        memory: Working memory in bytes beside the buffers; sets the height of strips.
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.
    """

    frame_numbers = ("exposure",)

    def __init__(
        self,
        preset: Literal["public", "paper"] = "public",
        features: Sequence[str] = ("normal", "albedo", "depth"),
        *,
        frames: int = 0,
        window: int = 9,
        patch: int = 3,
        prefilter_window: int = 5,
        final_window: int = 2,
        memory: int = 64_000_000,
        fused: bool | None = None,
    ) -> None:
        super().__init__()
        if preset not in ("public", "paper"):
            raise ValueError(f"NFOR: preset must be public or paper, got {preset!r}")
        if frames < 0:
            raise ValueError(f"NFOR: frames must be at least 0, got {frames}")
        for name in features:
            buffer(name)
        self.preset, self.features, self.frames = preset, tuple(features), frames
        self.memory, self.fused = memory, fused
        self.inputs = tuple(name for base in ("color", *self.features) for name in _parts(base))
        self._prefilter = PatchKernel(prefilter_window, patch, (0.5,), scale=2.0)
        self._refilter = PatchKernel(final_window, patch, (0.5,))
        self._first = PatchKernel(window, patch, BANDWIDTHS, scale=2.0, channels="least")
        last = 2.0 if preset == "public" else 1.0
        self._last = PatchKernel(window, patch, (1.0,), scale=last, channels="least")
        self._maps = PatchKernel(window, 1, (1.0,))
        filtered = self._prefilter.reach
        refiltered = filtered + self._refilter.reach
        first = 2 * window + max(patch, filtered if preset == "public" else refiltered)
        selected = max(first, window + 1) + 2 * window
        self.halo = 2 * window + max(selected + patch, refiltered)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color_a`, `color_b`, `color_variance`, and the same of each feature, (B, C, H, W), or
                (B, T, C, H, W) where windows span frames; optionally `exposure` (B,).
        """
        color = self.details(buffers).color
        return Denoised(color[:, color.shape[1] // 2] if self.frames else color)

    def sequence(self, buffers: Buffers) -> Tensor:
        """Return all frames of a sequence, (B, T, 3, H, W); with `frames` = 0 each by itself."""
        if self.frames:
            return self.details(buffers).color
        count = buffers[self.inputs[0]].shape[1]
        numbers = {n: buffers[n] for n in self.frame_numbers if n in buffers}
        stills = ({**{n: buffers[n][:, t] for n in self.inputs}, **numbers} for t in range(count))
        return torch.stack([self(still).color for still in stills], 1)

    def details(self, buffers: Buffers) -> Details:
        """Denoise and return what was estimated on the way; arguments as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        named = {n: _working(buffers[n]) for n in self.inputs}
        if not self.frames:
            named = {name: image[:, None] for name, image in named.items()}
        exposure = self.exposure({**buffers, self.inputs[0]: named["color_a"]})[:, None]
        colors = _Colors(*(named[n] for n in _parts("color")))
        colors = _Colors(colors.a * exposure, colors.b * exposure, colors.variance * exposure.square())
        features = self._filtered(named, colors.a)
        halves, errors, selection = self._first_pass(colors, features)
        color = self._last_pass(halves, features.final)
        channels = [buffer(name).channels for name in self.features]
        parts = dict(zip(self.features, features.final.split(channels, 2), strict=True))
        if not self.frames:
            color, selection = color[:, 0], selection[:, 0]
            errors, exposure = errors[:, :, 0], exposure[:, 0]
            parts = {name: part[:, 0] for name, part in parts.items()}
        scaled = (errors[0] / exposure.square(), errors[1] / exposure.square())
        return Details(color / exposure, scaled, selection, parts)

    def check(self, buffers: Buffers) -> tuple[int, int, int]:
        """Check names and shapes; sequences have their frames checked one by one."""
        if not self.frames:
            return super().check(buffers)
        frames = {n: t for n, t in buffers.items() if n in self.inputs}
        for name, tensor in frames.items():
            like = frames.get(self.inputs[0], tensor)
            if tensor.ndim != 5 or tensor.shape[1] != like.shape[1]:
                raise ValueError(
                    f"{type(self).__name__}: buffer {name!r} has shape {tuple(tensor.shape)}, expected a "
                    f"sequence (B, T, C, H, W) like {self.inputs[0]!r}"
                )
        return super().check({**buffers, **{n: t[:, 0] for n, t in frames.items()}})

    def _filtered(self, named: Mapping[str, Tensor], like: Tensor) -> _Features:
        """Filter each half of the features with weights of the other, then their mean (section 5.1)."""
        if not self.features:
            none = like[:, :, :0]
            return _Features(none, none, none)
        a, b, variance = (
            torch.cat([named[part] for part in parts], 2)
            for parts in zip(*(_parts(name) for name in self.features), strict=True)
        )
        a, b = self._cross_filtered(a, b, variance, self._prefilter)
        residual = 0.25 * (b - a).square()
        if self.preset == "paper":
            kernel = PatchKernel(self._refilter.window, self._refilter.patch, (0.5,), scale=2.0)
            a, b = self._cross_filtered(a, b, residual, kernel)
            return _Features(a, b, 0.5 * (a + b))
        mean = 0.5 * (a + b)
        return _Features(a, b, self._nlm(mean[None], mean, residual, self._refilter)[0])

    def _cross_filtered(
        self, a: Tensor, b: Tensor, variance: Tensor, kernel: PatchKernel
    ) -> tuple[Tensor, Tensor]:
        return (
            self._nlm(a[None], b, variance, kernel)[0],
            self._nlm(b[None], a, variance, kernel)[0],
        )

    def _nlm(self, images: Tensor, guide: Tensor, variance: Tensor, kernel: PatchKernel) -> Tensor:
        """Filter G images (G, B, T, C, H, W), each frame by itself."""
        flat = images.flatten(1, 2).transpose(0, 1)
        guides = [Guide(guide.flatten(0, 1), variance.flatten(0, 1))]
        return (
            nlm_filter(flat, guides, kernel, self.memory, fused=self.fused)
            .transpose(0, 1)
            .reshape(images.shape)
        )

    def _first_pass(self, colors: _Colors, features: _Features) -> tuple[_Colors, Tensor, Tensor]:
        """Return the selected halves with the variance of their mean, the errors (2, …) and the selection."""
        a = self._regression(colors.a, features.b, (colors.b, colors.variance), self._first)
        b = self._regression(colors.b, features.a, (colors.a, colors.variance), self._first)
        estimates = [
            estimated_error(colors.a, colors.b, colors.variance, *pair) for pair in zip(a, b, strict=True)
        ]
        mean, variance = colors.mean, colors.variance
        errors = self._nlm(torch.stack(estimates), mean, variance, self._maps)
        chosen = (errors[0] >= errors[1]).to(mean.dtype)
        selection = self._nlm(chosen[None], mean, variance, self._maps)[0]
        half_a, half_b = (torch.lerp(x[0], x[1], selection) for x in (a, b))
        return _Colors(half_a, half_b, 0.25 * (half_b - half_a).square()), errors, selection

    def _last_pass(self, halves: _Colors, features: Tensor) -> Tensor:
        mean = halves.mean
        return self._regression(mean, features, (mean, halves.variance), self._last)[0]

    def _regression(
        self, image: Tensor, features: Tensor, guide: tuple[Tensor, Tensor], kernel: PatchKernel
    ) -> list[Tensor]:
        """Return (B, T, 3, H, W) for each bandwidth."""
        frames = [
            Sample(image[:, t], features[:, t], Guide(guide[0][:, t], guide[1][:, t]))
            for t in range(image.shape[1])
        ]
        results = collaborative_regression(frames, kernel, self.frames, self.memory, fused=self.fused)
        return [torch.stack(result, 1) for result in results]


def estimated_error(a: Tensor, b: Tensor, variance: Tensor, filtered_a: Tensor, filtered_b: Tensor) -> Tensor:
    """Estimate the squared error of the mean of two filtered halves (section 5.3); may be negative.

    Each filtered half is compared with the other, noisy half, whose variance is 2 `variance`; the mean of
    both has less variance than a half, by a quarter of their squared difference.

    Args:
        a: Noisy half.
        b: The other noisy half.
        variance: Of the mean of both.
        filtered_a: Filtered first half.
        filtered_b: Filtered second half.
    """
    of_a = (b - filtered_a).square() - 2 * variance
    of_b = (a - filtered_b).square() - 2 * variance
    return 0.5 * (of_a + of_b) - 0.25 * (filtered_b - filtered_a).square()


def _parts(name: str) -> tuple[str, str, str]:
    return f"{name}_a", f"{name}_b", f"{name}_variance"


def _working(image: Tensor) -> Tensor:
    return image if image.dtype == torch.float64 else image.float()
