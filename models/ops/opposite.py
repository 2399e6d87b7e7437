"""Weights towards opposite neighbours, from colour patches and from features: the filters of RDFC.

Fabrice Rousselle, Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color Information",
Computer Graphics Forum 32(7), 2013, doi:10.1111/cgf.12219, as its released code has them. Towards
q1 = p + delta and q2 = p - delta there are three distances: to each, and to their mean. With m_i = min(v_p,
v_qi), k the bandwidth and e = 1e-10, each is the mean of the channels of

    [(u_p - u_qi)^2 - (v_p + m_i)] / (e + k^2 (v_p + v_qi))
    [(u_p - (u_q1 + u_q2) / 2)^2 - (v_p + (m_1 + m_2) / 4)] / (e + k^2 (v_p + (v_q1 + v_q2) / 4)).

Colours are averaged over a patch before w = exp(-max(0, d)), features are not; the denominators of features
have t = max(v, |grad f|^2, tau) for v. Of the weights w1, w2 and wS, r = clamp(wS / (w1 + w2) - 1, 0, 1) is
the share of wS where both d are below 25, else 0: both become r wS + (1 - r) w_i. A weight of colour may be
averaged over a box. The smallest of the colour's and the features' weights counts; a pixel's own weight is
the largest of the others, at least 1e-3. Neighbours outside the image are mirrored, -1 being pixel 0; boxes
lose what lies outside.

One call makes the weights of several rules (radius of the patch, tau): they share the distances of pixels,
which depend on neither, and an offset and its opposite share squares, minima and denominators.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from models.ops.joint import EPSILON, squared_gradient
from models.ops.symmetric import Boxes

NEAR = 25.0
"""Largest patch distance at which opposite neighbours are compared together."""

CENTRE = 1e-3
"""Least weight of a pixel in its own window."""

_CAP = 1e30
"""Distances stay below it, so that sums of them are finite; it is no part of the method."""


class Rule(NamedTuple):
    """Where a weight comes from.

    Attributes:
        patch: Radius of the colour's patches, None: the colour is not looked at.
        tau: Squared difference of a feature that always counts as small, None: they are not looked at.
    """

    patch: int | None
    tau: float | None = None


@dataclass(frozen=True)
class PairKernel:
    """How weights are made.

    Attributes:
        window: Radius of the window.
        rules: One weight for each; those that look at colour come first.
        bandwidth: k of the colour.
        feature_bandwidth: k of the features.
        smoothing: Radius of the box that averages weights of the colour, 0: none.
        own_spread: Denominators of the colour have v_p for v_q.
    """

    window: int
    rules: tuple[Rule, ...]
    bandwidth: float = 1.0
    feature_bandwidth: float = 0.6
    smoothing: int = 0
    own_spread: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.window < 1 or self.smoothing < 0 or any(patch < 0 for patch in self.patches):
            raise ValueError(
                "opposite neighbours need a window radius >= 1, patch and smoothing radii >= 0, got "
                f"{self.window}, {', '.join(map(str, self.patches)) or 'none'} and {self.smoothing}"
            )
        if not (self.bandwidth > 0 and self.feature_bandwidth > 0):
            raise ValueError(
                f"bandwidths must be positive, got {self.bandwidth} and {self.feature_bandwidth}"
            )
        if any(tau < 0 for tau in self.taus):
            raise ValueError(f"tau must be at least 0, got {', '.join(map(str, self.taus))}")

    @property
    def patches(self) -> tuple[int, ...]:
        """The different radii of patches."""
        return tuple(dict.fromkeys(rule.patch for rule in self.rules if rule.patch is not None))

    @property
    def taus(self) -> tuple[float, ...]:
        """The different tau."""
        return tuple(dict.fromkeys(rule.tau for rule in self.rules if rule.tau is not None))

    @property
    def margin(self) -> int:
        """How far weights of the colour look beside the two pixels."""
        return max(self.patches, default=0) + self.smoothing


class FeatureMap(NamedTuple):
    """A filtered feature.

    Attributes:
        image: (B, C, H, W).
        variance: Of its values, (B, C, H, W).
        unit: tau is in units of its square, (B, 1, 1, 1).
    """

    image: Tensor
    variance: Tensor
    unit: Tensor

    def spread(self, tau: float) -> Tensor:
        """Return t = max(v, |grad f|^2, tau unit^2)."""
        slope = torch.maximum(self.variance, squared_gradient(self.image))
        return torch.maximum(slope, tau * self.unit.square())


class Pixels(NamedTuple):
    """What pixels are filtered and compared by, (B, C, h, w) throughout.

    Attributes:
        images: What is filtered, and a channel of ones.
        u: Guide.
        v: Its variance.
        f: Features, all channels.
        fv: Their variances.
        t: Their spreads for each tau.
    """

    images: Tensor
    u: Tensor
    v: Tensor
    f: Tensor
    fv: Tensor
    t: tuple[Tensor, ...]


class Weights(NamedTuple):
    """Weights of two opposite neighbours.

    Attributes:
        still: For each rule, (B, K, 2, h, w).
        moved: For the rules that look at colour, had the pixel a brighter colour; None: not asked for.
    """

    still: Tensor
    moved: Tensor | None


class Pairs:
    """Weights between the pixels of some rows and their neighbours.

    Args:
        maps: `Pixels` side by side, mirrored around the image by the window.
        sizes: Their numbers of channels.
        groups: Number of channels of each feature.
        kernel: How weights are made.
        step: Also return the weights with the pixel's own colour times 1 + step; 0: do not.
    """

    def __init__(
        self, maps: Tensor, sizes: list[int], groups: list[int], kernel: PairKernel, step: float = 0.0
    ) -> None:
        self.maps, self.sizes, self.groups = maps, sizes, groups
        self.kernel, self.step = kernel, step
        self.size = tuple(side - 2 * kernel.window for side in maps.shape[-2:])
        self.own = self.at(0, 0)
        self.boxes = Boxes(self.own.u)

    def at(self, down: int, right: int) -> Pixels:
        """Return the pixels that lie there."""
        (height, width), top, left = self.size, self.kernel.window + down, self.kernel.window + right
        there = self.maps[..., top : top + height, left : left + width]
        images, u, v, f, fv, *t = there.split(self.sizes, 1)
        return Pixels(images, u, v, f, fv, tuple(t))

    def offsets(self) -> Iterator[tuple[int, int]]:
        """Yield one of each two opposite offsets."""
        window = self.kernel.window
        for down in range(window + 1):
            for right in range(-window if down else 1, window + 1):
                yield down, right

    def weights(self, sides: tuple[Pixels, Pixels]) -> Weights:
        """Return the weights of two opposite neighbours."""
        still, moved = self._color(sides) if self.kernel.patches else ({}, {})
        features = self._features(sides) if self.groups else {}
        own = self.own.v[:, :1]
        free = torch.ones_like(torch.cat([own, own], 1))  # where there is nothing to look at
        found: list[list[Tensor]] = [[], []]
        for patch, tau in self.kernel.rules:
            of_features = free if tau is None else features.get(tau, free)
            found[0].append(of_features if patch is None else torch.minimum(still[patch], of_features))
            if patch is not None and moved:
                with torch.no_grad():
                    found[1].append(torch.minimum(moved[patch], of_features))
        return Weights(torch.stack(found[0], 1), torch.stack(found[1], 1) if moved else None)

    def _color(self, sides: tuple[Pixels, Pixels]) -> tuple[dict[int, Tensor], dict[int, Tensor]]:
        """Return the weights (B, 2, h, w) of each patch radius, still and moved."""
        distances, changes = self._color_distances(sides)
        still, moved = {}, {}
        for patch in self.kernel.patches:
            means = self.boxes.mean(distances, patch)
            still[patch] = self._smooth(blended(means))
            if changes is not None:
                with torch.no_grad():  # of a box only the centre moves
                    moved[patch] = self._smooth(blended(means + changes / (2 * patch + 1) ** 2))
        return still, moved

    def _smooth(self, weights: Tensor) -> Tensor:
        return self.boxes.mean(weights, self.kernel.smoothing) if self.kernel.smoothing else weights

    def _color_distances(self, sides: tuple[Pixels, Pixels]) -> tuple[Tensor, Tensor | None]:
        """Return d of pixels, (B, 3, h, w), and how much larger it is with the moved colour."""
        (u, v), squared = (self.own.u, self.own.v), self.kernel.bandwidth**2
        spreads = [v, v] if self.kernel.own_spread else [side.v for side in sides]
        terms = _terms([u - side.u for side in sides], v, [side.v for side in sides], spreads)
        own, share = v + EPSILON / squared, 1 / (squared * u.shape[1])
        distances, changes = [], []
        for difference, noise, spread in terms:
            inverse = (own + spread).reciprocal()
            distances.append(((difference.square() - noise) * inverse).sum(1, keepdim=True))
            if self.step:
                with torch.no_grad():  # (x + s u)^2 - x^2
                    change = self.step * u * (2 * difference + self.step * u)
                    changes.append((change * inverse).sum(1, keepdim=True))
        d = _capped(torch.cat(distances, 1) * share)
        return d, _capped(torch.cat(changes, 1) * share) if changes else None

    def _features(self, sides: tuple[Pixels, Pixels]) -> dict[float, Tensor]:
        """Return the smallest of the features' weights, (B, 2, h, w), for each tau."""
        own, squared = self.own, self.kernel.feature_bandwidth**2
        steps, noises = [own.f - side.f for side in sides], [side.fv for side in sides]
        found = {}
        for i, tau in enumerate(self.kernel.taus):
            spreads = [side.t[i] for side in sides]
            d = []
            for difference, noise, spread in _terms(steps, own.fv, noises, spreads):
                each = (difference.square() - noise) / (own.t[i] + EPSILON / squared + spread)
                means = [part.mean(1) for part in each.split(self.groups, 1)]
                d.append(torch.stack(means, 1) / squared)
            found[tau] = blended(_capped(torch.stack(d, 1))).amin(2)
        return found


def _terms(
    steps: list[Tensor], v: Tensor, noises: list[Tensor], spreads: list[Tensor]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield difference, variance to subtract and the neighbours' part of the spread, thrice."""
    least = [torch.minimum(v, noise) for noise in noises]
    for step, minimum, spread in zip(steps, least, spreads, strict=True):
        yield step, v + minimum, spread
    yield 0.5 * (steps[0] + steps[1]), v + 0.25 * (least[0] + least[1]), 0.25 * (spreads[0] + spreads[1])


def _capped(d: Tensor) -> Tensor:
    return torch.where(d < _CAP, d, _CAP)  # not a number becomes the cap


def blended(distances: Tensor) -> Tensor:
    """Return the weights of both neighbours, (B, 2, …); distances: to both and to their mean, (B, 3, …)."""
    weights = torch.exp(-distances.clamp_min(0.0))
    both, mean = weights[:, :2], weights[:, 2:]
    total = both.sum(1, keepdim=True).clamp_min(math.exp(-NEAR))
    near = torch.maximum(distances[:, :1], distances[:, 1:2]) < NEAR
    share = torch.where(near, (mean / total - 1).clamp(0.0, 1.0), 0.0)
    return torch.lerp(both, mean, share)
