"""Two half buffers and their variance: what filters read, and what stands in where a frame lacks some of it.

Methods that filter one half of the samples with the weights of the other need for each buffer X two halves
and the variance of their mean. `Noise` names where these come from:

    measured    X_a, X_b, X_variance   as the renderer wrote them
    halves      X_a, X_b               variance of the mean = (a - b)^2 / 4, smoothed (below)
    variance    X, X_variance          the mean stands for both halves
    estimated   X                      the same, with a variance estimated from the image
    none        X                      the same, free of noise

`halves` is for low-discrepancy samples, whose sample variance says more than there is (sections 5.3 and 7 of
NFOR, doi:10.1111/cgf.12954), and for frames without variances. The squared difference has one degree of
freedom: its standard deviation is 1.4 times its mean. `smoothing` is the radius of the box that averages it,
0 being the plain difference of the NFOR paper. (RKZ12 and RDFC, doi:10.1111/cgf.12219, smooth theirs as well,
with the help of the sample variance, which is not read here.)

`estimated` is John Immerkær's: "Fast noise variance estimation", Computer Vision and Image Understanding
64(2), 1996, doi:10.1006/cviu.1996.0060. The mask [1 -2 1; -2 4 -2; 1 -2 1] cancels constants, gradients and
straight edges along rows or columns; of white noise it leaves a standard deviation of 6 sigma, thus

    sigma = sqrt(pi / 2) / 6 * mean of |mask * X|

there over the whole image, here over a box around each pixel, since noise of renderings differs from place to
place. Absolute values keep single outliers from counting squared. Bias: too high where there is texture or an
edge that is neither horizontal nor vertical; too low for noise with heavy tails and for pixels that share
samples; for normal noise +3 % in the mean and -2 % in the median, from squaring a mean of few values.

Measured on stills of 32 samples per pixel whose variance is known: the mean of |log2 of the ratio to it| of
`halves` is 1.0 to 1.6 with a box of radius 1, 2.2 to 2.4 without, and larger again with wider boxes; of
`estimated` 1.1 to 2.2 with radius 3. On a frame full of fireflies all are wrong: 2.9 and 3.6.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from data.buffers import buffer
from models.ops.boxes import box_sum_valid

Noise = Literal["measured", "halves", "variance", "estimated", "none"]
"""Where halves and variance of a buffer come from."""

ColorNoise = Literal["measured", "halves", "variance", "estimated"]
"""The same for the colour, which is what is filtered: it always has noise."""

SMOOTHING = 1
"""Radius of the box that averages the squared difference of two halves."""

ESTIMATE = 3
"""Radius of the box over which `estimated_variance` looks."""

WRITTEN = "`trainer render stills` writes halves and variances"
"""What makes halves and variances."""

MADE = f"{WRITTEN}; color_noise=estimated needs color alone; feature_noise=none takes features as they are"
"""What makes halves and variances, or does without."""

_PARTS: dict[str, tuple[str, ...]] = {
    "measured": ("_a", "_b", "_variance"),
    "halves": ("_a", "_b"),
    "variance": ("", "_variance"),
    "estimated": ("",),
    "none": ("",),
}
_INSTEAD: dict[str, tuple[Noise, ...]] = {
    "measured": ("halves", "variance"),
    "halves": ("variance",),
    "variance": ("halves",),
}
_REASONS = {
    "halves": "the difference of the halves {0}_a and {0}_b stands for the variance, which is less exact",
    "variance": "{0}, the mean, stands for both halves, so that weights share the noise of what they filter",
}


class Halves(NamedTuple):
    """Two halves and how noisy they are, (..., C, H, W).

    Attributes:
        a: Half A, or the mean where there are no halves.
        b: Half B, or the mean.
        variance: Half of the variance of `a`, and of `b`; that is, where they are independent, the variance
            of their mean.
    """

    a: Tensor
    b: Tensor
    variance: Tensor

    @property
    def mean(self) -> Tensor:
        """Mean of both halves."""
        return 0.5 * (self.a + self.b)


def independent(noise: Noise) -> bool:
    """Say whether the halves are two buffers, and not one that stands for both."""
    return noise in ("measured", "halves")


def inputs(name: str, noise: Noise) -> tuple[str, ...]:
    """Return the names of the buffers that are read for `name`."""
    return tuple(name + part for part in _PARTS[noise])


def reach(noise: Noise, smoothing: int = SMOOTHING) -> int:
    """Return how far a variance looks from its pixel."""
    return {"halves": smoothing, "estimated": ESTIMATE + 1}.get(noise, 0)


def halves(buffers: Mapping[str, Tensor], name: str, noise: Noise, smoothing: int = SMOOTHING) -> Halves:
    """Return the halves of a buffer and their variance.

    Args:
        buffers: Hold `inputs(name, noise)`, (..., C, H, W), H and W at least 3.
        name: Of the plain buffer.
        noise: Where halves and variance come from.
        smoothing: Radius of the box that averages squared differences of halves.
    """
    first, *others = (_working(buffers[n]) for n in inputs(name, noise))
    if noise == "measured":
        return Halves(first, others[0], others[1])
    if noise == "halves":
        return Halves(first, others[0], halves_variance(first, others[0], smoothing))
    if noise == "variance":
        return Halves(first, first, 0.5 * others[0])
    if noise == "estimated":
        return Halves(first, first, 0.5 * estimated_variance(first))
    return Halves(first, first, torch.zeros_like(first))


def halves_variance(a: Tensor, b: Tensor, smoothing: int = SMOOTHING) -> Tensor:
    """Estimate the variance of the mean of two halves, (a - b)^2 / 4 averaged over a box.

    Args:
        a: (..., C, H, W).
        b: The other half.
        smoothing: Radius of the box, of which only the part inside the image counts; 0: none.
    """
    square = 0.25 * (a - b).square()
    return _box_mean(F.pad(square, [smoothing] * 4), square, smoothing) if smoothing else square


def estimated_variance(image: Tensor, radius: int = ESTIMATE) -> Tensor:
    """Estimate the variance of the pixels of an image from the image alone (see the module).

    Args:
        image: (..., C, H, W), H and W at least 3.
        radius: Of the box around each pixel, at least 1.
    """
    across = image[..., :-2] - 2 * image[..., 1:-1] + image[..., 2:]
    mask = across[..., :-2, :] - 2 * across[..., 1:-1, :] + across[..., 2:, :]
    mean = _box_mean(F.pad(mask.abs(), [radius + 1] * 4), mask, radius, 1)
    return (math.pi / 2 / 36) * mean.square()


def _box_mean(padded: Tensor, like: Tensor, radius: int, margin: int = 0) -> Tensor:
    """Average the part of each box that lies inside `like`, at its pixels and `margin` more on each side."""
    inside = F.pad(like.new_ones(1, 1, *like.shape[-2:]), [radius + margin] * 4)
    return box_sum_valid(padded, 2 * radius + 1) / box_sum_valid(inside, 2 * radius + 1)[0]


def possible(name: str, noise: Noise, available: Collection[str]) -> tuple[Noise, str] | None:
    """Return where halves and variance can come from instead, and one sentence of why.

    `estimated` and `none` are for the user to choose and never returned.

    Args:
        name: Of the plain buffer.
        noise: Where they were to come from.
        available: Names of the buffers that there are.

    Returns:
        None where no other way is left; also where none is needed, so look at `inputs` first.
    """
    missing = [part for part in inputs(name, noise) if part not in available]
    for other in _INSTEAD.get(noise, ()):
        if missing and all(part in available for part in inputs(name, other)):
            reason = _REASONS[other].format(name)
            return other, f"no {' and no '.join(missing)}: {reason}"
    return None


def substituted(
    noises: Mapping[str, Noise], available: Collection[str]
) -> tuple[dict[str, Noise], list[str]] | None:
    """Return where halves and variances of all buffers can come from, and one sentence for each that changed.

    Args:
        noises: Name of the plain buffer → where they were to come from.
        available: Names of the buffers that there are.

    Returns:
        None where nothing is missing, or one buffer has no other way left.
    """
    changed, reasons = dict(noises), []
    for name, noise in noises.items():
        if not all(part in available for part in inputs(name, noise)):
            found = possible(name, noise, available)
            if found is None:
                return None
            changed[name], reason = found
            reasons.append(reason)
    return (changed, reasons) if reasons else None


def checked(option: str, noise: Noise, allowed: Collection[str] = get_args(Noise)) -> Noise:
    """Refuse a word that is not one of `Noise`, and return it otherwise.

    Raises:
        ValueError: Names the option and what it may be.
    """
    if noise not in allowed:
        raise ValueError(f"{option} must be one of {', '.join(allowed)}, got {noise!r}")
    return noise


def of_features(method: str, features: Sequence[str], noise: Noise | Sequence[Noise]) -> dict[str, Noise]:
    """Return where each feature's halves come from.

    Args:
        method: Name of the method, for messages.
        features: Names of plain buffers.
        noise: One word for all, or one for each.

    Raises:
        ValueError: A feature is unknown, the colour or given twice, or there is not one word for each.
    """
    for name in features:
        buffer(name)
    if len(set(features) | {"color"}) != len(features) + 1:
        raise ValueError(
            f"{method}: features must be different buffers beside color, got {', '.join(features)}"
        )
    noises = [noise] * len(features) if isinstance(noise, str) else list(noise)
    if len(noises) != len(features):
        raise ValueError(
            f"{method}: feature_noise must be one word, or one for each of the {len(features)} features, "
            f"got {len(noises)}"
        )
    return {f: checked(f"{method}: feature_noise", n) for f, n in zip(features, noises, strict=True)}


def _working(image: Tensor) -> Tensor:
    return image if image.dtype == torch.float64 else image.float()
