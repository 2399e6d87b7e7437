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
by normal equations with a ridge of 5e-7. Distances are computed on radiance times `exposure`, since their
small constant (1e-7) has the units of a variance; where no exposure is given that is the public behaviour.

Without halves of the colour (`color_noise` = `variance` or `estimated`) no independent half is there to take
weights and features from and to estimate errors with: a filter compared with the very noise that it saw seems
best where it does least. There is then one regression, with k = 0.5 and the features of the last pass, and no
second pass, whose variance would be unknown.

Published: best mean and least spread of MSE, relative MSE, PSNR and SSIM over 21 scenes (figure 10), 223 s
and 3.2 GB per image (table 2).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from data.buffers import buffer
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops import halves
from models.ops.features import Prefilter, filter_frames
from models.ops.fireflies import KEPT, Fireflies, checked, limited_halves
from models.ops.halves import ColorNoise, Halves, Noise
from models.ops.nlm import UNROLLED, Guide, PatchKernel
from models.ops.regression import Sample, collaborative_regression

BANDWIDTHS = (0.5, 1.0)
"""Candidates for k, section 5.3."""

SINGLE = 0.5
"""The bandwidth where there are no halves to select by. Section 5.3 calls it reasonable for most scenes; on
parts of six stills it gave 24.8 dB on average, k = 1 gave 24.1 dB; with estimated variances 25.0 and 23.9."""


class Details(NamedTuple):
    """What NFOR knows beside the image; every tensor has the leading axes of the input.

    Attributes:
        color: Filtered radiance (B, 3, H, W).
        errors: Estimated and filtered mean squared error of each bandwidth, (B, 3, H, W) in squared units of
            the input; may be negative. None where one buffer stands for both halves of the colour.
        selection: Share of the larger bandwidth, (B, 3, H, W) in [0, 1]. None where `errors` is.
        features: Filtered features by name, as the last regression uses them.
    """

    color: Tensor
    errors: tuple[Tensor, Tensor] | None
    selection: Tensor | None
    features: dict[str, Tensor]

    def layers(self) -> dict[str, Tensor]:
        """Return everything but the colour by name."""
        found = dict(self.features)
        if self.errors is not None and self.selection is not None:
            found |= {f"error_k{k:g}": error for k, error in zip(BANDWIDTHS, self.errors, strict=True)}
            found["selection"] = self.selection
        return found


class NFOR(Denoiser):
    """NFOR; reads two half buffers and the variance of their mean, of the colour and of every feature.

    Images, or sequences (B, T, C, H, W) where `frames` is not 0 (section 6 of the paper): then windows span
    frames as far as they exist, the frame index is a feature, and the result is the middle frame (`sequence`
    returns all). Patches lie in one frame each and are compared across frames without motion compensation,
    as in the work on movies that the paper cites (doi:10.1007/s11263-007-0052-1). Features and maps are
    filtered frame by frame. Memory per pixel then counts for each frame.

    Args:
        preset: `public` does what the authors' implementation does, `paper` what their text says where that
            differs.
        features: Names of the buffers that the regression uses, any subset of the vocabulary; may be empty.
        frames: Frames before and after a pixel's own that its window spans; the paper uses 2.
        color_noise: Where halves and variance of the colour come from: `measured` reads all three, `halves`
            takes the variance from the difference of both halves, `variance` reads the mean and its variance,
            `estimated` the image alone (`models.ops.halves`). The last two have no halves to select by: one
            regression, one bandwidth.
        feature_noise: The same for features, one word for all or one for each; `none` takes them as free of
            noise and does not filter them.
        smoothing: Radius of the box in which `halves` averages squared differences.
        fireflies: `keep` them, as paper and public implementation do, or `limit` the halves of the colour by
            each other before anything else, see `models.ops.fireflies`; needs two halves.
        aux: Return errors, selection and filtered features as `Denoised.aux`.
        window: Radius of the regression window and of the windows that filter maps.
        patch: Radius of the patches.
        prefilter_window: Radius of the window that filters the features' halves.
        final_window: Radius of the window that filters features once more.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.
    """

    frame_numbers = ("exposure",)
    no_export = UNROLLED

    def __init__(
        self,
        preset: Literal["public", "paper"] = "public",
        features: Sequence[str] = ("normal", "albedo", "depth"),
        *,
        frames: int = 0,
        color_noise: ColorNoise = "measured",
        feature_noise: Noise | Sequence[Noise] = "measured",
        smoothing: int = halves.SMOOTHING,
        fireflies: Fireflies = "keep",
        aux: bool = False,
        window: int = 9,
        patch: int = 3,
        prefilter_window: int = 5,
        final_window: int = 2,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        self._arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        if preset not in ("public", "paper"):
            raise ValueError(f"NFOR: preset must be public or paper, got {preset!r}")
        if frames < 0 or smoothing < 0:
            raise ValueError(f"NFOR: frames and smoothing must be at least 0, got {frames} and {smoothing}")
        self.features = tuple(features)
        own = halves.checked("NFOR: color_noise", color_noise, get_args(ColorNoise))
        self.noises = {"color": own, **halves.of_features("NFOR", self.features, feature_noise)}
        self.inputs = tuple(n for base, noise in self.noises.items() for n in halves.inputs(base, noise))
        self.preset, self.frames, self.smoothing = preset, frames, smoothing
        self.fireflies = checked("NFOR", fireflies, own)
        self.aux, self.memory, self.fused = aux, memory, fused
        second: Literal["mean", "halves"] = "mean" if preset == "public" else "halves"
        self._prefilter = Prefilter(prefilter_window, patch, final_window, second, memory, fused)
        self._first = PatchKernel(window, patch, BANDWIDTHS, scale=2.0, channels="least")
        self._only = PatchKernel(window, patch, (SINGLE,), scale=2.0, channels="least")
        last = 2.0 if preset == "public" else 1.0
        self._last = PatchKernel(window, patch, (1.0,), scale=last, channels="least")
        self._maps = PatchKernel(window, 1, (1.0,))
        self.halo = self._reach()
        self.frame_halo = 2 * frames * (2 if self._selects else 1)
        # Measured: growth of resident memory at 384x384 and 512x512, 0 to 14 channels of features, the larger
        # of both forms; the PyTorch form takes up to `memory` for its strips beside that.
        self.bytes_per_pixel = 320 + 26 * sum(buffer(name).channels for name in self.features)

    @property
    def _selects(self) -> bool:
        """Whether there are halves of the colour, by which to select a bandwidth and filter twice."""
        return halves.independent(self.noises["color"])

    def _reach(self) -> int:
        """Return how far a pixel looks on each side."""
        window, patch = self._first.window, self._first.patch
        measured = {name: halves.reach(noise, self.smoothing) for name, noise in self.noises.items()}
        color = patch + measured["color"] + (self.fireflies == "limit")
        noisy = [name for name in self.features if self.noises[name] != "none"]
        once = max((measured[name] + self._prefilter.reach for name in noisy), default=0)
        final = max((measured[name] + self._prefilter.reach_final for name in noisy), default=0)
        if not self._selects:
            return 2 * window + max(color, final)
        selected = 2 * window + max(color, once) + 2 * window
        return 2 * window + max(selected + patch, final)

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return NFOR with halves and variances from what there is; see `Denoiser.instead`."""
        found = halves.substituted(self.noises, available)
        if found is None:
            return None
        noises, reasons = found
        color_noise, *feature_noise = noises.values()
        changed: dict[str, Any] = {"color_noise": color_noise, "feature_noise": feature_noise}
        if self._selects and not halves.independent(color_noise):
            reasons[0] += "; NFOR then fits once, with one bandwidth"
            if self.fireflies == "limit":
                reasons[0] += KEPT
                changed["fireflies"] = "keep"
        return NFOR(**{**self._arguments, **changed}), tuple(reasons)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color_a`, `color_b`, `color_variance` and the same of each feature, or what the noise
                options name, (B, C, H, W), or (B, T, C, H, W) where windows span frames; optionally
                `exposure` (B,).
        """
        found = self._denoised(self.details(buffers))
        if not self.frames:
            return found
        middle = found.color.shape[1] // 2
        aux = found.aux and {name: layer[:, middle] for name, layer in found.aux.items()}
        return Denoised(found.color[:, middle], None, aux)

    def sequence(self, buffers: Buffers) -> Tensor:
        """Return all frames of a sequence, (B, T, 3, H, W); with `frames` = 0 each by itself."""
        return self.clip(buffers).color

    def clip(self, buffers: Buffers) -> Denoised:
        """Return all frames of a sequence and, where asked for, `aux`, all (B, T, C, H, W)."""
        if self.frames:
            return self._denoised(self.details(buffers))
        numbers = {n: buffers[n] for n in self.frame_numbers if n in buffers}
        count = buffers[self.inputs[0]].shape[1]
        found = [self({**{n: buffers[n][:, t] for n in self.inputs}, **numbers}) for t in range(count)]
        layers = [f.aux for f in found if f.aux is not None]
        aux = {n: torch.stack([layer[n] for layer in layers], 1) for n in layers[0]} if layers else None
        return Denoised(torch.stack([f.color for f in found], 1), None, aux)

    def _denoised(self, details: Details) -> Denoised:
        return Denoised(details.color, None, details.layers() if self.aux else None)

    def details(self, buffers: Buffers) -> Details:
        """Denoise and return what was estimated on the way; arguments as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        colors, exposure = self._exposed(buffers)
        filtered = [self._prefilter(self._halves(buffers, n), self.noises[n]) for n in self.features]
        known = _joined([f.final for f in filtered], colors.a)
        channels = [buffer(name).channels for name in self.features]
        final = dict(zip(self.features, known.split(channels, 2), strict=True))
        if not self._selects:
            (color,) = self._regression(colors.a, known, (colors.a, colors.variance), self._only)
            return self._unexposed(Details(color, None, None, final), exposure)
        a, b = (_joined([getattr(f, half) for f in filtered], colors.a) for half in "ab")
        del filtered
        colors, errors, selection = self._first_pass(colors, a, b)
        del a, b
        (color,) = self._regression(colors.mean, known, (colors.mean, colors.variance), self._last)
        return self._unexposed(Details(color, (errors[0], errors[1]), selection, final), exposure)

    def _exposed(self, buffers: Buffers) -> tuple[Halves, Tensor]:
        """Return the colour times exposure, its fireflies limited where asked for, and the exposure."""
        colors = self._halves(buffers, "color")
        exposure = self.exposure({**buffers, self.inputs[0]: colors.a})[:, None]
        if "exposure" in buffers:
            a, b, variance = colors
            colors = Halves(a * exposure, b * exposure, variance * exposure.square())
        return limited_halves(colors) if self.fireflies == "limit" else colors, exposure

    def _unexposed(self, details: Details, exposure: Tensor) -> Details:
        """Return details in the units of the input and with its axes."""
        color, errors, selection, features = details
        color = color / exposure
        if errors is not None:
            errors = (errors[0] / exposure.square(), errors[1] / exposure.square())
        if self.frames:
            return Details(color, errors, selection, features)
        return Details(
            color[:, 0],
            errors and (errors[0][:, 0], errors[1][:, 0]),
            None if selection is None else selection[:, 0],
            {name: image[:, 0] for name, image in features.items()},
        )

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

    def _halves(self, buffers: Buffers, name: str) -> Halves:
        """Return the halves of a buffer, (B, T, C, H, W)."""
        found = halves.halves(buffers, name, self.noises[name], self.smoothing)
        return found if self.frames else Halves(*(image[:, None] for image in found))

    def _first_pass(
        self, colors: Halves, features_a: Tensor, features_b: Tensor
    ) -> tuple[Halves, Tensor, Tensor]:
        """Return the selected halves with the variance of their mean, the errors (2, …) and the selection."""
        a = self._regression(colors.a, features_b, (colors.b, colors.variance), self._first)
        b = self._regression(colors.b, features_a, (colors.a, colors.variance), self._first)
        estimates = torch.stack([estimated_error(colors, *pair) for pair in zip(a, b, strict=True)])
        errors = self._mapped(estimates, colors)
        del estimates
        # A tie, and where an error is not a number, selects the larger bandwidth.
        chosen = (~(errors[0] < errors[1])).to(errors.dtype)
        selection = self._mapped(chosen[None], colors)[0]
        half_a, half_b = (torch.lerp(x[0], x[1], selection) for x in (a, b))
        return Halves(half_a, half_b, 0.25 * (half_b - half_a).square()), errors, selection

    def _mapped(self, maps: Tensor, colors: Halves) -> Tensor:
        """Filter maps with the weights of the noisy image."""
        return filter_frames(maps, colors.mean, colors.variance, self._maps, self.memory, fused=self.fused)

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


def estimated_error(noisy: Halves, filtered_a: Tensor, filtered_b: Tensor) -> Tensor:
    """Estimate the squared error of the mean of two filtered halves (section 5.3); may be negative.

    Each filtered half is compared with the other, noisy half, whose variance is twice that of the mean; the
    mean of both has less variance than a half, by a quarter of their squared difference.

    Args:
        noisy: The noisy halves and the variance of their mean.
        filtered_a: Filtered first half.
        filtered_b: Filtered second half.
    """
    of_a = (noisy.b - filtered_a).square() - 2 * noisy.variance
    of_b = (noisy.a - filtered_b).square() - 2 * noisy.variance
    return 0.5 * (of_a + of_b) - 0.25 * (filtered_b - filtered_a).square()


def _joined(features: Sequence[Tensor], like: Tensor) -> Tensor:
    """Return features as one image (B, T, K, H, W), K = 0 where there are none."""
    return torch.cat([like[:, :, :0], *features], 2)
