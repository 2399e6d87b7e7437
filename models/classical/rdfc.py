"""RDFC: three joint filters, and at every pixel the one whose estimated error is least.

Fabrice Rousselle, Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color Information",
Computer Graphics Forum 32(7), 2013, doi:10.1111/cgf.12219.

Features are filtered by non-local means. Three candidates follow, whose weights are the smallest of those of
the colour and of every feature: FIRST compares colours by small patches, which keeps detail and leaves noise,
SECOND by larger ones, THIRD looks at features alone and more closely. Stein's unbiased risk estimate

    SURE = (F - C)^2 + 2 V dF/dC - V,   the mean of the channels,

says how far each is from the truth without knowing it: F is the filtered colour, C the noisy one, V its
variance. The estimates are smoothed, the least one selects, the selection is smoothed, and the mix of the
candidates is filtered once more with what its halves still differ by.

The steps are those of the authors' released code: weights in `models.ops.opposite`, the derivative in
`models.ops.paired`. What is decided here, since it is not known:

- Boxes that smooth weights, and the blur of variances, lose what lies outside the image.
- FIRST is eligible only where its derivative is not larger than SECOND's (the mean of the channels, before
  any smoothing). The released code reads SECOND's from other pixels by mistake; the rule is what it meant.
  `guarded=False` does without.
- In the second pass the colour's denominators have 2 v_p for v_p + v_q: where opposite neighbours are
  compared together that makes v_p + v_p / 2. Those of features stay as they are.
- tau of depth is relative to the largest depth of the frame, that of positions to their largest coordinate.
- Without halves of the colour (`color_noise` = `variance` or `estimated`) nothing tells how noisy the mix is:
  it is the result. SURE needs no halves.

Radiance, features and variances that are not finite count as 0. Distances are computed on radiance times
`exposure`, since their small constant has the units of a variance.

Published: 41 s and 349 MB per image on average over 21 scenes (table 2 of NFOR, doi:10.1111/cgf.12954, which
has the authors' own comparison with it). Reached on the six stills that ship, at 32 samples per pixel:
geometric mean of relMSE (exposed, epsilon 0.01) 0.0346, that of the input 0.133, of `JointNLM` 0.0554, of
`NFOR` 0.0431. On one of them, indoor-000002, it is worse than both: 0.079, 0.034 and 0.044.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from data.buffers import buffer
from models.classical.nlm import Sampling
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops import halves
from models.ops.fireflies import KEPT, Fireflies, checked, limited_halves
from models.ops.guides import depth_range, finite
from models.ops.halves import ColorNoise, Halves, Noise
from models.ops.nlm import UNROLLED, Guide
from models.ops.opposite import FeatureMap, PairKernel, Rule
from models.ops.paired import pair_filter
from models.ops.risk import blurred, chosen_maps, estimated_risk
from models.ops.symmetric import scaled_variance

CANDIDATES = ("first", "second", "third")

_SAMPLED = 10
"""Radius over which the variance of low-discrepancy samples is compared with the difference of the halves."""


class Selected(NamedTuple):
    """The mix of the candidates.

    Attributes:
        color: (B, 3, H, W).
        difference: Half of the difference of its halves, (B, 3, H, W).
        errors: Smoothed SURE of each candidate, (B, 3 candidates, H, W), in squared units of the colour; may
            be negative.
        shares: Of each candidate, (B, 3 candidates, H, W), with the sum 1.
    """

    color: Tensor
    difference: Tensor
    errors: Tensor
    shares: Tensor


class RDFC(Denoiser):
    """RDFC; reads two half buffers and the variance of their mean, of the colour and of every feature.

    Args:
        features: Names of buffers with halves and variance, such as `normal`, `albedo`, `depth`, `position`,
            `visibility`; with `position` images are not cut into tiles. Empty: THIRD averages its window.
        window: Radius of the candidates' windows, 10 as the authors' default; a later port has 20.
        patches: Radii of the patches by which FIRST and SECOND compare colours.
        patch: Radius of the patches of all other filters, whose weights are averaged over a radius one less.
        bandwidth: k of the colour.
        feature_bandwidth: k of the features.
        tau: Squared difference of a feature that always counts as small, of FIRST and SECOND.
        third_tau: The same of THIRD.
        prefilter_window: Radius of the window that filters features.
        step: Relative change of a pixel's colour that gives the derivative.
        guarded: Leave FIRST out where its derivative is larger than SECOND's.
        error_window: Radius of the window that smooths estimated errors.
        selection_window: Radius of the window that smooths the selection.
        second_pass: Whether the mix is filtered once more.
        second_window: Radius of that window, None: half of `window`.
        second_tau: tau of that pass.
        color_noise: Where halves and variance of the colour come from: `measured` reads all three, `halves`
            takes the variance from the difference of both halves, `variance` reads the mean and its variance,
            `estimated` the image alone (`models.ops.halves`). The last two have no second pass.
        feature_noise: The same for features, one word for all or one for each; `none` takes them as free of
            noise and does not filter them.
        sampling: `low-discrepancy` scales measured variances, which are too large then, by what the halves
            say; see `models.ops.symmetric.scaled_variance`.
        fireflies: `keep` them, or `limit` the halves of the colour by each other before anything else, see
            `models.ops.fireflies`; needs two halves.
        aux: Return `shares` (of each candidate), `error_first`, `error_second`, `error_third`
            and each filtered feature by its name, normals within [-1, 1], albedo at most 1.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
    """

    frame_numbers: tuple[str, ...] = ("exposure", "depth_range")
    no_export = UNROLLED

    def __init__(
        self,
        features: Sequence[str] = ("normal", "albedo", "depth"),
        *,
        window: int = 10,
        patches: Sequence[int] = (1, 3),
        patch: int = 3,
        bandwidth: float = 0.45,
        feature_bandwidth: float = 0.6,
        tau: float = 1e-3,
        third_tau: float = 1e-4,
        prefilter_window: int = 5,
        step: float = 0.01,
        guarded: bool = True,
        error_window: int = 1,
        selection_window: int = 5,
        second_pass: bool = True,
        second_window: int | None = None,
        second_tau: float = 1e-4,
        color_noise: ColorNoise = "measured",
        feature_noise: Noise | Sequence[Noise] = "measured",
        sampling: Sampling = "random",
        fireflies: Fireflies = "keep",
        aux: bool = False,
        memory: int | None = None,
    ) -> None:
        self._arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        if len(patches) != 2 or not step > 0:
            raise ValueError(f"RDFC: expected two radii as patches and a step > 0, got {patches} and {step}")
        self.features = tuple(features)
        own = halves.checked("RDFC: color_noise", color_noise, get_args(ColorNoise))
        self.noises = {"color": own, **halves.of_features("RDFC", self.features, feature_noise)}
        if sampling not in get_args(Sampling):
            raise ValueError(f"RDFC: sampling must be {' or '.join(get_args(Sampling))}, got {sampling!r}")
        if sampling != "random" and "measured" not in self.noises.values():
            raise ValueError(f"RDFC: sampling={sampling} corrects measured variances, and none is read")
        self.fireflies, self.sampling = checked("RDFC", fireflies, own), sampling
        self.inputs = tuple(n for base, noise in self.noises.items() for n in halves.inputs(base, noise))
        if "depth" not in self.features:
            self.frame_numbers = ("exposure",)
        self.whole = any(self._is_distance(name) and name != "depth" for name in self.features)
        self.step, self.guarded, self.aux, self.memory = step, guarded, aux, memory
        self.second_pass = second_pass and halves.independent(own)
        self._set_kernels(second_window)
        self.halo = self._reach()
        # Measured: growth of resident memory from 384x384 to 768x768, 0 and 7 channels of features; strips
        # take up to `memory` beside that.
        self.bytes_per_pixel = 470 + 72 * sum(buffer(name).channels for name in self.features)

    def _set_kernels(self, second_window: int | None) -> None:
        """Say how each filter makes its weights."""
        given = self._arguments
        small, large = given["patches"]
        tau, third, bandwidths = (
            given["tau"],
            given["third_tau"],
            (given["bandwidth"], given["feature_bandwidth"]),
        )
        candidates = (Rule(small, tau), Rule(large, tau), Rule(None, third))
        self._candidates = PairKernel(given["window"], candidates, *bandwidths)
        patch, smoothing = given["patch"], max(0, given["patch"] - 1)
        self._prefilter = PairKernel(given["prefilter_window"], (Rule(patch),), smoothing=smoothing)
        self._errors = PairKernel(given["error_window"], (Rule(patch),), smoothing=smoothing)
        self._selection = PairKernel(given["selection_window"], (Rule(patch),), smoothing=smoothing)
        window = max(1, given["window"] // 2) if second_window is None else second_window
        second = (Rule(patch, given["second_tau"]),)
        self._second = PairKernel(window, second, *bandwidths, smoothing, True)

    @staticmethod
    def _is_distance(name: str) -> bool:
        return buffer(name).kind == "distance"

    def _reach(self) -> int:
        """Return how far a pixel looks on each side."""

        def variance(name: str) -> int:
            sampled = _SAMPLED if self._is_scaled(name) else 0
            return halves.reach(self.noises[name]) + sampled

        color = variance("color") + (self.fireflies == "limit")
        noisy = [variance(name) for name in self.features if self.noises[name] != "none"]
        filtered = self._prefilter.window + self._prefilter.margin
        # The residual variance is blurred, and there are gradients: a pixel further.
        feature = (max(noisy) + filtered + 1 if noisy else 1) if self.features else 0
        candidates = self._candidates.window + max(self._candidates.margin + color, feature)
        errors = self._errors.window + max(self._errors.margin + color, candidates)
        mix = max(self._selection.window + max(self._selection.margin + color, errors), candidates)
        if not self.second_pass:
            return mix
        return self._second.window + max(self._second.margin + 1 + mix, feature)

    def _is_scaled(self, name: str) -> bool:
        return self.sampling == "low-discrepancy" and self.noises[name] == "measured"

    def made_by(self, missing: Collection[str]) -> str:
        """Say what makes halves and variances, or does without."""
        return halves.MADE

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return this method with halves and variances from what there is; see `Denoiser.instead`."""
        found = halves.substituted(self.noises, available)
        if found is None:
            return None
        noises, reasons = found
        color_noise, *feature_noise = noises.values()
        changed: dict[str, Any] = {"color_noise": color_noise, "feature_noise": feature_noise}
        if halves.independent(self.noises["color"]) and not halves.independent(color_noise):
            reasons[0] += "; RDFC then has no second pass"
            if self.fireflies == "limit":
                reasons[0] += KEPT
                changed["fireflies"] = "keep"
        if "measured" not in noises.values():
            changed["sampling"] = "random"
        return RDFC(**{**self._arguments, **changed}), tuple(reasons)

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2), smallest and largest depth of whole frames, where depth is read."""
        if "depth" not in self.features:
            return {}
        return {"depth_range": depth_range(halves.halves(buffers, "depth", self.noises["depth"]).mean)}

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color_a`, `color_b`, `color_variance` and the same of each feature, or what the noise
                options name, (B, C, H, W); optionally `exposure` (B,) and `depth_range` (B, 2).
        """
        self.check(buffers)
        color = self._halves(buffers, "color")
        exposure = self.exposure({**buffers, self.inputs[0]: color.a})
        color = Halves(color.a * exposure, color.b * exposure, color.variance * exposure.square())
        if self.fireflies == "limit":
            color = limited_halves(color)
        features = {name: self._feature(buffers, name) for name in self.features}
        maps = list(features.values())
        mix = self._selected(color, maps)
        filtered = self._filtered_again(mix, maps) if self.second_pass else mix.color
        return Denoised(filtered / exposure, aux=self._layers(mix, features, exposure) if self.aux else None)

    def _halves(self, buffers: Buffers, name: str) -> Halves:
        """Return halves of finite numbers and the variance of their mean."""
        noise = self.noises[name]
        found = Halves(*(finite(x) for x in halves.halves(buffers, name, noise)))
        if self._is_scaled(name):
            return found._replace(variance=scaled_variance(found.variance, found.a, found.b, _SAMPLED))
        return found if halves.independent(noise) else found._replace(variance=2 * found.variance)

    def _feature(self, buffers: Buffers, name: str) -> FeatureMap:
        """Return a filtered feature with the variance that is left."""
        given = _normalised(self._halves(buffers, name), name)
        mean, unit = given.mean, torch.ones_like(given.a[:1, :1, :1, :1])
        if self._is_distance(name):
            bounds = buffers.get("depth_range") if name == "depth" else None
            largest = mean.detach().abs().amax((1, 2, 3)) if bounds is None else finite(bounds)[:, 1]
            unit = largest.to(mean.dtype)[:, None, None, None]
        if self.noises[name] == "none":
            return FeatureMap(mean, torch.zeros_like(mean), unit)
        parts = torch.cat([0.5 * (given.a - given.b), mean], 1)
        found = pair_filter(parts, Guide(mean, given.variance), self._prefilter, budget=self.memory)
        difference, image = found.images[:, 0].chunk(2, 1)
        return FeatureMap(image, blurred(difference.square()), unit)

    def _selected(self, color: Halves, features: list[FeatureMap]) -> Selected:
        """Filter the colour by each candidate, estimate the errors and mix."""
        noisy = Guide(color.mean, color.variance)
        parts = torch.cat([0.5 * (color.a - color.b), noisy.image], 1)
        images, derivative = pair_filter(
            parts, noisy, self._candidates, features, self.memory, step=self.step
        )
        assert derivative is not None
        risk = estimated_risk(images[:, :, 3:].detach(), noisy, derivative)
        errors = self._smooth(risk, noisy, self._errors)
        chosen = chosen_maps(errors, derivative.mean(2) if self.guarded else None)
        shares = self._smooth(chosen, noisy, self._selection)
        shares = shares / shares.sum(1, keepdim=True)
        difference, mix = (shares[:, :, None] * images).sum(1).chunk(2, 1)
        return Selected(mix, difference, errors, shares)

    def _smooth(self, maps: Tensor, noisy: Guide, kernel: PairKernel) -> Tensor:
        return pair_filter(maps, noisy, kernel, budget=self.memory).images[:, 0]

    def _filtered_again(self, mix: Selected, features: list[FeatureMap]) -> Tensor:
        guide = Guide(mix.color, blurred(mix.difference.square()))
        return pair_filter(mix.color, guide, self._second, features, self.memory).images[:, 0]

    def _layers(self, mix: Selected, features: dict[str, FeatureMap], exposure: Tensor) -> dict[str, Tensor]:
        errors = (mix.errors / exposure.square()).split(1, 1)
        layers = {"shares": mix.shares}
        layers |= {f"error_{name}": error for name, error in zip(CANDIDATES, errors, strict=True)}
        for name, feature in features.items():
            layers[name] = 2 * feature.image - 1 if name == "normal" else feature.image
        return layers


def _normalised(given: Halves, name: str) -> Halves:
    """Return normals within [0, 1] and albedo scaled to at most 1; other features as they are."""
    a, b, variance = given
    if name == "normal":
        return Halves(0.5 * a + 0.5, 0.5 * b + 0.5, 0.25 * variance)
    if name != "albedo":
        return given
    scale = given.mean.amax(1, keepdim=True).clamp_min(1.0).reciprocal()
    return Halves(a * scale, b * scale, variance * scale.square())
