"""LBF: a cross-bilateral filter whose parameters a small network predicts for every pixel.

Nima Khademi Kalantari, Steve Bako, Pradeep Sen: "A Machine Learning Approach for Filtering Monte Carlo
Noise", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766977.

Features (position, normal, albedo of the first and of the second hit, visibility of the light) are filtered
by non-local means. From 7 statistics of each (`models.ops.secondary_features`) and 1 / samples per pixel, 36
numbers, a network of one hidden layer of 10 predicts 6 positive numbers: how much distances in the image and
in each feature count in a window of 55x55 pixels (`models.ops.scaled_bilateral`). It is trained through the
filter, on (c' - c)^2 / (c^2 + 0.01). Variances of the colour, and the result, lose their spikes
(`models.ops.spikes`).

The steps and numbers are those of the authors' released code, whose factor of the colour's distance is 0.01;
the paper prints 1 / (2 * 7^2), which is `color_factor=0.0102`. Its weights are not free, and are not used.
What is decided here, since it is not known:

- Distances (position, depth) are relative to the largest of the frame, so that the least variance 1e-4 means
  the same in every scene; positions of training patches to the largest of the patch.
- The 36 numbers are normalised by mean and standard deviation of the first batch of a training, and the last
  layer starts with small weights around a broad filter (`models.blocks.pixel_parameters`).
- `exposure` multiplies the colour first, since the small constant of its distance has the units of a
  variance.

Reached on the still of the sample that is held out, after 80 steps on the other five (`lbf_sample.yaml`):
PSNR 27.27 dB and half the relative squared error 0.0132, as AFGSA prints them; the noisy still has 22.50 dB
and 0.0595. The paper's figures are averages over scenes that are not public.

Radiance, features and variances that are not finite count as 0, and what is beyond 1e9 (variances 1e18) as
that. 436 parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from data.buffers import SECOND_ALBEDO, SECOND_HIT_MADE, buffer
from models.blocks.pixel_parameters import PixelParameters
from models.classical.nlm import Sampling
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops import halves, secondary_features
from models.ops.group_nlm import GroupKernel, group_nlm
from models.ops.guides import depth_range, finite
from models.ops.halves import ColorNoise, Noise
from models.ops.nlm import UNROLLED, Guide
from models.ops.scaled_bilateral import BilateralRule, Pixels, scaled_bilateral
from models.ops.spikes import without_spikes
from models.ops.symmetric import scaled_variance

PAPER = ("position", "normal", "albedo", SECOND_ALBEDO, "visibility")
"""Groups of features in the paper."""

_SAMPLED = 10
"""Radius over which the variance of low-discrepancy samples is compared with the difference of the halves."""

_LARGEST = 1e9
"""Values stay below it, so that products of variances are finite."""

_START = (0.005, 0.05)
"""Where predictions begin: of the distance in the image, and of features."""


class Features(NamedTuple):
    """Features as the filter sees them.

    Attributes:
        groups: Filtered image and residual variance of each.
        statistics: What the network sees, not normalised, (B, 7 groups + 1, H, W).
    """

    groups: dict[str, Guide]
    statistics: Tensor


class LBF(Denoiser):
    """LBF; reads two half buffers and the variance of their mean, of the colour and of every feature.

    Args:
        features: Groups, names of buffers; with `position` images are not cut into tiles.
        window: Radius of the window.
        color_factor: Of the colour's distance; 0.0102 in the paper.
        least_variance: Of a feature, below which distances are not divided by less.
        hidden: Width of the hidden layer.
        samples_per_pixel: Of all frames; the network sees 1 / it.
        prefilter_window: Radius of the window that filters features.
        prefilter_patch: Radius of the patches that this compares.
        prefilter_smoothing: Radius of the box that averages its weights.
        variance_spikes: Standard deviations beyond which a variance of the colour is replaced; None: never.
        spike_window: Radius of the window that these are seen in.
        output_spikes: Standard deviations in 3x3 pixels beyond which a result is replaced; None: never.
        color_noise: Where halves and variance of the colour come from: `measured` reads all three, `halves`
            takes the variance from the difference of both halves, `variance` reads the mean and its variance,
            `estimated` the image alone (`models.ops.halves`).
        feature_noise: The same for features, one word for all or one for each; `none` takes them as free of
            noise and does not filter them.
        sampling: `low-discrepancy` scales measured variances by what the halves say, as the authors do
            always; see `models.ops.symmetric.scaled_variance`. `random`: they are taken as they are.
        aux: Return `scale_image` and `scale_<feature>`, what the network predicts, and each filtered feature
            by its name.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    frame_numbers: tuple[str, ...] = ("exposure", "depth_range")
    no_export = UNROLLED

    def __init__(
        self,
        features: Sequence[str] = PAPER,
        *,
        window: int = 27,
        color_factor: float = 0.01,
        least_variance: float = 1e-4,
        hidden: int = 10,
        samples_per_pixel: float = 32.0,
        prefilter_window: int = 5,
        prefilter_patch: int = 3,
        prefilter_smoothing: int = 2,
        variance_spikes: float | None = 10.0,
        spike_window: int = 27,
        output_spikes: float | None = 2.0,
        color_noise: ColorNoise = "measured",
        feature_noise: Noise | Sequence[Noise] = "measured",
        sampling: Sampling = "low-discrepancy",
        aux: bool = False,
        memory: int | None = None,
    ) -> None:
        self._arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        self._check_arguments()
        self.features = tuple(features)
        own = halves.checked("LBF: color_noise", color_noise, get_args(ColorNoise))
        self.noises = {"color": own, **halves.of_features("LBF", self.features, feature_noise)}
        self.inputs = tuple(n for base, noise in self.noises.items() for n in halves.inputs(base, noise))
        if "depth" not in self.features:
            self.frame_numbers = ("exposure",)
        self.whole = any(_is_distance(name) and name != "depth" for name in self.features)
        self.sampling, self.samples_per_pixel = sampling, samples_per_pixel
        self.least_variance, self.aux, self.memory = least_variance, aux, memory
        self.variance_spikes, self.output_spikes = variance_spikes, output_spikes
        self.spike_window = spike_window
        self.rule = BilateralRule(tuple(buffer(n).channels for n in self.features), window, color_factor)
        self._prefilter = GroupKernel(prefilter_window, prefilter_patch, prefilter_smoothing)
        starts = (_START[0], *[_START[1]] * len(self.features))
        self.network = PixelParameters(secondary_features.NUMBERS * len(self.features) + 1, hidden, starts)
        self.halo = self._reach()
        # Measured: growth of resident memory from 384x384 to 640x640, 0 and 13 channels of features; strips
        # take up to `memory` beside that.
        self.bytes_per_pixel = 480 + 45 * sum(self.rule.groups)

    def _check_arguments(self) -> None:
        given = self._arguments
        if given["sampling"] not in get_args(Sampling):
            raise ValueError(
                f"LBF: sampling must be {' or '.join(get_args(Sampling))}, got {given['sampling']!r}"
            )
        if not (given["least_variance"] > 0 and given["samples_per_pixel"] > 0):
            raise ValueError(
                "LBF: expected a least_variance and samples_per_pixel above 0, got "
                f"{given['least_variance']} and {given['samples_per_pixel']}"
            )
        if given["hidden"] < 1 or given["spike_window"] < 1:
            raise ValueError(
                "LBF: expected hidden and spike_window of at least 1, got "
                f"{given['hidden']} and {given['spike_window']}"
            )
        for name in ("variance_spikes", "output_spikes"):
            if given[name] is not None and not given[name] > 0:
                raise ValueError(f"LBF: {name} must be above 0, or none, got {given[name]}")

    def _reach(self) -> int:
        """Return how far a pixel looks on each side."""

        def variance(name: str) -> int:
            return halves.reach(self.noises[name]) + (_SAMPLED if self._is_scaled(name) else 0)

        color = variance("color") + (self.spike_window if self.variance_spikes is not None else 0)
        noisy = [variance(name) for name in self.features if self.noises[name] != "none"]
        feature = max(noisy) + self._prefilter.reach if noisy else 0
        # Blocks of statistics reach further than their other windows, on what is not filtered.
        own = max(feature + secondary_features.WINDOW, secondary_features.REACH) if self.features else 0
        filtered = max(self.rule.window + max(color, feature), own)
        return filtered + (self.output_spikes is not None)

    def _is_scaled(self, name: str) -> bool:
        return self.sampling == "low-discrepancy" and self.noises[name] == "measured"

    def made_by(self, missing: Collection[str]) -> str:
        """Say what makes halves and variances, second hits among them, or does without."""
        second = any(name.startswith((SECOND_ALBEDO, "position_")) for name in missing)
        return f"{SECOND_HIT_MADE}; {halves.MADE}" if second else halves.MADE

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return this method with halves and variances from what there is; see `Denoiser.instead`."""
        found = halves.substituted(self.noises, available)
        if found is None:
            return None
        noises, reasons = found
        color_noise, *feature_noise = noises.values()
        changed: dict[str, Any] = {"color_noise": color_noise, "feature_noise": feature_noise}
        other = LBF(**{**self._arguments, **changed})
        other.load_state_dict(self.state_dict())
        return other.train(self.training), tuple(reasons)

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2), smallest and largest depth of whole frames, where depth is read."""
        if "depth" not in self.features:
            return {}
        return {"depth_range": depth_range(halves.halves(buffers, "depth", self.noises["depth"]).mean)}

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`. In training the first call measures what the input is
        normalised by.

        Args:
            buffers: `color_a`, `color_b`, `color_variance` and the same of each feature, or what the noise
                options name, (B, C, H, W); optionally `exposure` (B,) and `depth_range` (B, 2).
        """
        self.check(buffers)
        with torch.autocast(buffers[self.inputs[0]].device.type, enabled=False):
            color = self._noisy(buffers, "color")
            exposure = self.exposure({**buffers, self.inputs[0]: color.image})
            color = Guide(color.image * exposure, color.variance * exposure.square())
            if self.variance_spikes is not None:
                color = self._calm(color, self.variance_spikes)
            features = self._features(buffers, color.image)
            scales = self.network(features.statistics)
            filtered = scaled_bilateral(self._pixels(color, features), scales, self.rule, self.memory)
            if self.output_spikes is not None:
                filtered = without_spikes(filtered, 1, self.output_spikes)
            layers = self._layers(buffers, scales, features) if self.aux else None
            return Denoised(filtered / exposure, aux=layers)

    def _calm(self, color: Guide, limit: float) -> Guide:
        """Return the colour with the spikes of its variance replaced."""
        return Guide(color.image, without_spikes(color.variance, self.spike_window, limit))

    def _noisy(self, buffers: Buffers, name: str) -> Guide:
        """Return the mean of the halves and its variance, finite, distances relative to the farthest."""
        noise = self.noises[name]
        a, b, variance = (finite(x) for x in halves.halves(buffers, name, noise))
        a, b = (x.clamp(-_LARGEST, _LARGEST) for x in (a, b))
        variance = variance.clamp(0.0, _LARGEST**2)
        if _is_distance(name):
            unit = _farthest(0.5 * (a + b), buffers, name)
            a, b, variance = a / unit, b / unit, variance / unit.square()
        if self._is_scaled(name):
            variance = scaled_variance(variance, a, b, _SAMPLED)
        elif not halves.independent(noise):
            variance = 2 * variance
        return Guide(0.5 * (a + b), variance)

    def _features(self, buffers: Buffers, color: Tensor) -> Features:
        """Return filtered features and their statistics."""
        given = {name: self._noisy(buffers, name) for name in self.features}
        noisy = [name for name in self.features if self.noises[name] != "none"]
        filtered = group_nlm([given[name] for name in noisy], self._prefilter, self.memory)
        groups = {**given, **dict(zip(noisy, filtered, strict=True))}
        statistics = [color.new_full((*color.shape[:1], 1, *color.shape[2:]), 1 / self.samples_per_pixel)]
        if groups:
            unfiltered = [guide.image for guide in given.values()]
            statistics.insert(0, secondary_features.secondary_features(list(groups.values()), unfiltered))
        return Features(groups, torch.cat(statistics, 1))

    def _pixels(self, color: Guide, features: Features) -> Pixels:
        none = color.image[:, :0]
        images = torch.cat([none, *(guide.image for guide in features.groups.values())], 1)
        variances = torch.cat([none, *(guide.variance for guide in features.groups.values())], 1)
        return Pixels(color.image, color.variance, images, variances.clamp_min(self.least_variance))

    def _layers(self, buffers: Buffers, scales: Tensor, features: Features) -> dict[str, Tensor]:
        names = ("image", *self.features)
        layers = {f"scale_{n}": scale for n, scale in zip(names, scales.split(1, 1), strict=True)}
        for name, guide in features.groups.items():
            layers[name] = guide.image
            if _is_distance(name):  # in the unit of the buffer again
                mean = halves.halves(buffers, name, self.noises[name]).mean
                layers[name] = guide.image * _farthest(finite(mean), buffers, name)
        return layers


def _is_distance(name: str) -> bool:
    return buffer(name).kind == "distance"


def _farthest(distance: Tensor, buffers: Buffers, name: str) -> Tensor:
    """Return the largest absolute distance of whole frames, (B, 1, 1, 1), 1 where all are 0."""
    bounds = buffers.get("depth_range") if name == "depth" else None
    largest = distance.detach().abs().amax((1, 2, 3)) if bounds is None else finite(bounds)[:, 1]
    return torch.where(largest > 0, largest, 1.0).to(distance.dtype)[:, None, None, None]
