"""WLR: weighted local regression in a reduced feature space, a denoiser without training.

Bochang Moon, Nathan Carr, Sung-Eui Yoon: "Adaptive Rendering Based on Weighted Local Regression", ACM
Transactions on Graphics 33(5), 2014, doi:10.1145/2641762. Every pixel is the value of a linear function of
position and features that is fitted to its window, in the directions that stand out of the features' noise.
A bandwidth for each direction comes from the curvature of the image along it, one that all share from
estimates of bias and variance for five trials; `models.ops.local_regression` has the equations. With
`prefilter` it is WLR-PF of NFOR's comparison (`models.classical.nfor`): the same with features that are
filtered as NFOR filters them.

The numbers are those of the authors' code, which is what is described here; their adaptive sampling, whose
passes use a window of radius 5, is not. Five points differ from it or are not known of it:

- The singular values that are compared with the noise are those of the scaled features. That code may take
  a square root once more.
- It limits the variance of a feature's samples to 1; how many samples a pixel has is not known here, and
  the limit is on the variance of their mean.
- The ridge leaves the constant out, so that a constant image stays constant.
- Windows are cut off at the border of the image.
- The variance of filtered features, which the comparison does not name, is a quarter of the squared
  difference of the filtered halves.

Colours are compared, and curvatures measured, on radiance times `exposure`, since their constants have units.

NFOR's section 4.5 names what WLR falls behind for: noisy features are cut off where they could be filtered
(`prefilter`), weights do not look at the colour, and bandwidths on a continuous scale are hard to estimate.

Published: 72 s and 309 MB per image, WLR-PF 91 s and 311 MB (NFOR, table 2).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from data.buffers import buffer
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops import halves
from models.ops.feature_windows import Noisy
from models.ops.features import Prefilter
from models.ops.fireflies import KEPT, Fireflies, checked, limited_halves
from models.ops.halves import ColorNoise, Halves, Noise
from models.ops.local_regression import LocalRule, local_regression

NO_EXPORT = (
    "it needs the eigenvectors of a matrix at every pixel, for which ONNX has no operator; use it from "
    "Python or with `trainer denoise`"
)
"""Why it is not exported."""


class Details(NamedTuple):
    """What WLR knows beside the image.

    Attributes:
        color: Filtered radiance (B, 3, H, W).
        bandwidth: h, smoothed, (B, 1, H, W) in [0.01, 1].
        rank: Directions of the features, position included, that were kept, (B, 1, H, W).
        features: The features by name, as they were used.
    """

    color: Tensor
    bandwidth: Tensor
    rank: Tensor
    features: dict[str, Tensor]


class WLR(Denoiser):
    """WLR; reads the mean and the variance of the colour and of every feature.

    Args:
        features: Names of the buffers that the regression uses, any subset of the vocabulary; may be empty.
            Channels of a buffer are scaled together.
        prefilter: Filter the features as NFOR does, preset `public` (WLR-PF); needs their halves.
        window: Radius of the window.
        trials: Shared bandwidths that are tried, at least two.
        least_bandwidth: Smallest shared bandwidth, taken where the variance does not fall with it.
        map_sigma: Standard deviation in pixels of the Gaussian that smooths shared bandwidths; 0: none.
        least_scale: Features whose largest deviation in a window is below this are not scaled up further.
        noise_factor: How many times the noise of the features a singular value must exceed.
        least_singular: Added to that.
        least_curvature: Added to curvatures: bandwidths are at most 1 / sqrt of this.
        quadratic_ridge: Ridge of the quadratic fit that measures curvatures.
        ridge: Ridge of the linear fits.
        color_factor: How many standard deviations, summed over both pixels, a neighbour may differ.
        color_floor: Added to that, exposed radiance.
        variance_limit: Larger variances of features, and such that are not a number, count as this; squared
            units of the feature.
        color_noise: Where the mean and the variance of the colour come from: `variance` reads both,
            `measured` and `halves` take the mean of two halves, `estimated` reads the image alone
            (`models.ops.halves`).
        feature_noise: The same for features, one word for all or one for each; `none` takes them as free of
            noise. None: `measured` with `prefilter`, otherwise `variance`.
        smoothing: Radius of the box in which `halves` averages squared differences.
        fireflies: `keep` them, or `limit` the halves of the colour by each other before anything else, see
            `models.ops.fireflies`; needs two halves.
        patch: Radius of the patches of `prefilter`.
        prefilter_window: Radius of the window that filters the features' halves.
        final_window: Radius of the window that filters features once more.
        aux: Return `bandwidth`, the shared one, and `directions`, the share that was kept, both (B, 1, H, W)
            in [0, 1], and with `prefilter` the filtered features as `Denoised.aux`.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.
    """

    frame_numbers = ("exposure",)
    no_export = NO_EXPORT

    def __init__(
        self,
        features: Sequence[str] = ("depth", "normal", "albedo"),
        *,
        prefilter: bool = False,
        window: int = 9,
        trials: Sequence[float] = (0.2, 0.4, 0.6, 0.8, 1.0),
        least_bandwidth: float = 0.01,
        map_sigma: float = 1.0,
        least_scale: float = 0.01,
        noise_factor: float = 2.0,
        least_singular: float = 0.01,
        least_curvature: float = 0.16,
        quadratic_ridge: float = 1e-3,
        ridge: float = 1e-4,
        color_factor: float = 3.0,
        color_floor: float = 0.005,
        variance_limit: float = 1.0,
        color_noise: ColorNoise = "variance",
        feature_noise: Noise | Sequence[Noise] | None = None,
        smoothing: int = halves.SMOOTHING,
        fireflies: Fireflies = "keep",
        patch: int = 3,
        prefilter_window: int = 5,
        final_window: int = 2,
        aux: bool = False,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        given = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        self._arguments = given
        names = LocalRule.__dataclass_fields__
        self.rule = LocalRule(**{**{n: given[n] for n in names}, "trials": tuple(trials)})
        if smoothing < 0 or not variance_limit >= 0:
            raise ValueError(
                f"WLR: smoothing and variance_limit must be at least 0, got {smoothing} and {variance_limit}"
            )
        self.features = tuple(features)
        own = halves.checked("WLR: color_noise", color_noise, get_args(ColorNoise))
        usual: Noise = "measured" if prefilter else "variance"
        of_features = halves.of_features("WLR", self.features, feature_noise or usual)
        self.noises: dict[str, Noise] = {"color": own, **of_features}
        self.inputs = tuple(n for base, noise in self.noises.items() for n in halves.inputs(base, noise))
        self.fireflies = checked("WLR", fireflies, own)
        self.smoothing, self.variance_limit, self.aux = smoothing, variance_limit, aux
        self.memory, self.fused = memory, fused
        self._prefilter = (
            Prefilter(prefilter_window, patch, final_window, "mean", memory, fused) if prefilter else None
        )
        self.halo = self._reach()
        self._dimensions = dimensions = 2 + sum(buffer(name).channels for name in self.features)
        # Axes and bandwidths are kept between the two passes, joined from blocks, and inputs in float64.
        # Measured with 9 dimensions: resident memory grows by 1940 to 2190 at 320x320 to 640x640.
        self.bytes_per_pixel = 16 * dimensions * (dimensions + 4) + 400

    def _reach(self) -> int:
        """Return how far a pixel looks on each side."""
        measured = {name: halves.reach(noise, self.smoothing) for name, noise in self.noises.items()}
        looked = [max(measured.pop("color"), int(self.fireflies == "limit"))]
        for name, reach in measured.items():
            filtered = self._prefilter is not None and self.noises[name] != "none"
            looked.append(reach + (self._prefilter.reach_final if filtered and self._prefilter else 0))
        return self.rule.window + self.rule.map_reach + max(looked)

    def made_by(self, missing: Collection[str]) -> str:
        """Say what makes halves and variances, or does without."""
        return halves.MADE

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return WLR with means and variances from what there is; see `Denoiser.instead`."""
        found = halves.substituted(self.noises, available)
        if found is None:
            return None
        noises, reasons = found
        color_noise, *feature_noise = noises.values()
        changed: dict[str, Any] = {"color_noise": color_noise, "feature_noise": feature_noise}
        if self.fireflies == "limit" and not halves.independent(color_noise):
            reasons[0] += KEPT
            changed["fireflies"] = "keep"
        return WLR(**{**self._arguments, **changed}), tuple(reasons)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color` and `color_variance` and the same of each feature, or what the noise options
                name, (B, C, H, W); optionally `exposure` (B,).
        """
        found = self.details(buffers)
        layers = {"bandwidth": found.bandwidth, "directions": found.rank / self._dimensions}
        if self._prefilter is not None:
            layers |= found.features
        return Denoised(found.color, None, layers if self.aux else None)

    def details(self, buffers: Buffers) -> Details:
        """Denoise and return what was estimated on the way; arguments as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        color = self._halves(buffers, "color")
        exposure = self.exposure({**buffers, self.inputs[0]: color.a})
        color = Halves(color.a * exposure, color.b * exposure, color.variance * exposure.square())
        if self.fireflies == "limit":
            color = limited_halves(color)
        features = {name: self._feature(buffers, name) for name in self.features}
        found = local_regression(
            self._mean(color, self.noises["color"]),
            list(features.values()),
            self.rule,
            self.memory,
            fused=self.fused,
        )
        used = {name: feature.image for name, feature in features.items()}
        return Details(found.color / exposure, found.bandwidth, found.rank, used)

    def _halves(self, buffers: Buffers, name: str) -> Halves:
        return halves.halves(buffers, name, self.noises[name], self.smoothing)

    def _mean(self, parts: Halves, noise: Noise) -> Noisy:
        """Return the mean and its variance."""
        if halves.independent(noise):
            return Noisy(parts.mean, parts.variance)
        return Noisy(parts.a, 2 * parts.variance)

    def _feature(self, buffers: Buffers, name: str) -> Noisy:
        """Return a feature, filtered where asked for, and the variance that it has or is left with."""
        parts, noise = self._halves(buffers, name), self.noises[name]
        if self._prefilter is None:
            image, variance = self._mean(parts, noise)
        else:
            filtered = self._prefilter(Halves(*(x[:, None] for x in parts)), noise)
            a, b, image = (x[:, 0] for x in filtered)
            variance = 0.25 * (b - a).square()
        limit = self.variance_limit
        return Noisy(image, torch.nan_to_num(variance, limit, limit, limit).clamp(0.0, limit))
