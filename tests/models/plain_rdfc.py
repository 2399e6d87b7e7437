"""RDFC written down literally in float64: every filter by itself, and the derivative by filtering again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tests.models.plain_nlm import Array, gradient, neighbour, window

EPS = 1e-10


class Feature(NamedTuple):
    """A filtered feature (H, W, C), its variance, and the unit of tau."""

    image: Array
    variance: Array
    unit: float


@dataclass(frozen=True)
class Filter:
    """One filter: radii of window, patch (None: no colour) and weight box, both k, tau, 2 v_p below."""

    window: int
    patch: int | None
    smoothing: int = 0
    k: float = 1.0
    k_feature: float = 0.6
    tau: float | None = None
    twice_own: bool = False


class Result(NamedTuple):
    image: Array
    centre_share: Array


def box_mean(image: Array, radius: int) -> Array:
    """Average the part of every box that is inside."""
    height, width = image.shape
    padded, inside = (np.pad(x, radius) for x in (image, np.ones_like(image)))
    total, count = np.zeros_like(image), np.zeros_like(image)
    for down in range(2 * radius + 1):
        for right in range(2 * radius + 1):
            total += padded[down : down + height, right : right + width]
            count += inside[down : down + height, right : right + width]
    return np.asarray(total / count)


Sides = tuple[Array, Array]
"""The same of both neighbours."""


def distances(u: Array, u_q: Sides, v: Array, v_q: Sides, s: Array, s_q: Sides, k: float) -> list[Array]:
    """Return d of pixels (H, W) to both neighbours and their mean: values u, variances v, spreads s."""
    m = [np.minimum(v, x) for x in v_q]
    found = [((u - u_q[i]) ** 2 - (v + m[i])) / (EPS + k * k * (s + s_q[i])) for i in range(2)]
    numerator = (u - (u_q[0] + u_q[1]) / 2) ** 2 - (v + (m[0] + m[1]) / 4)
    found.append(numerator / (EPS + k * k * (s + (s_q[0] + s_q[1]) / 4)))
    return [d.mean(-1) for d in found]


def pair_weights(d: list[Array]) -> list[Array]:
    """Return the weights of both neighbours from the three distances."""
    w1, w2, w_s = (np.exp(-np.maximum(0.0, x)) for x in d)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.clip(w_s / (w1 + w2) - 1, 0, 1)
    r = np.where((d[0] < 25) & (d[1] < 25), r, 0.0)
    return [r * w_s + (1 - r) * w1, r * w_s + (1 - r) * w2]


def color_weights(
    u: Array, v: Array, offset: tuple[int, int], how: Filter, brighter: float = 0.0
) -> list[Array]:
    """Return the colour's weights towards +offset and -offset; `brighter`: the centre's colour times that."""
    assert how.patch is not None
    sides = [offset, (-offset[0], -offset[1])]
    u_q = (neighbour(u, *sides[0]), neighbour(u, *sides[1]))
    v_q = (neighbour(v, *sides[0]), neighbour(v, *sides[1]))
    spreads = (v, v) if how.twice_own else v_q
    d = distances(u, u_q, v, v_q, v, spreads, how.k)
    means = [box_mean(x, how.patch) for x in d]
    if brighter:
        other = distances(brighter * u, u_q, v, v_q, v, spreads, how.k)
        means = [m + (y - x) / (2 * how.patch + 1) ** 2 for m, x, y in zip(means, d, other, strict=True)]
    weights = pair_weights(means)
    return [box_mean(w, how.smoothing) for w in weights] if how.smoothing else weights


def feature_weights(feature: Feature, t: Array, offset: tuple[int, int], how: Filter) -> list[Array]:
    f, v = feature.image, feature.variance
    f_q, v_q, t_q = ((neighbour(x, *offset), neighbour(x, -offset[0], -offset[1])) for x in (f, v, t))
    return pair_weights(distances(f, f_q, v, v_q, t, t_q, how.k_feature))


def run(
    image: Array, guide: tuple[Array, Array], how: Filter, features: Sequence[Feature] = (),
    brighter: float = 0.0,
) -> Result:  # fmt: skip
    """Filter (H, W, C); with `brighter` every pixel as if only its own colour were larger by that factor."""
    total, norm = np.zeros_like(image), np.zeros(image.shape[:2])
    largest = np.full(image.shape[:2], 1e-3)
    spreads = []
    for f, v, unit in features if how.tau is not None else ():
        assert how.tau is not None
        spreads.append(np.maximum(np.maximum(v, gradient(f)), how.tau * unit**2))
    for offset in [o for o in window(how.window) if o > (0, 0)]:
        weights = [np.ones(image.shape[:2])] * 2
        if how.patch is not None:
            weights = color_weights(*guide, offset, how, brighter)
        for feature, t in zip(features, spreads, strict=False):
            own = feature_weights(feature, t, offset, how)
            weights = [np.minimum(*w) for w in zip(weights, own, strict=True)]
        for side, w in zip((offset, (-offset[0], -offset[1])), weights, strict=True):
            total += w[..., None] * neighbour(image, *side)
            norm += w
            largest = np.maximum(largest, w)
    total += largest[..., None] * (brighter * image if brighter else image)
    norm += largest
    return Result(total / norm[..., None], largest / norm)


def derivative(color: Array, variance: Array, how: Filter, features: Sequence[Feature], step: float) -> Array:
    """Return dF/dC (H, W, 3)."""
    still = run(color, (color, variance), how, features)
    share = np.repeat(still.centre_share[..., None], 3, -1)
    if how.patch is None:
        return share
    moved = run(color, (color, variance), how, features, 1 + step)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (moved.image - still.image) / (step * color)
    inside = np.all((found >= 0) & (found <= 1), axis=-1)
    return np.where(inside[..., None], found, share)


def blurred(image: Array) -> Array:
    """Blur by separable taps 0.1353, 1, 0.1353 over what lies inside."""
    height, width, _ = image.shape
    taps = {-1: np.exp(-2), 0: 1.0, 1: np.exp(-2)}
    result = np.zeros_like(image)
    for y in range(height):
        for x in range(width):
            total, norm = np.zeros(image.shape[2]), 0.0
            for down, a in taps.items():
                for right, b in taps.items():
                    if 0 <= y + down < height and 0 <= x + right < width:
                        total, norm = total + a * b * image[y + down, x + right], norm + a * b
            result[y, x] = total / norm
    return result


def filtered_feature(
    a: Array, b: Array, variance: Array, radius: int, unit: float = 1.0, patch: int = 3
) -> Feature:
    """Filter both halves with the weights of their mean."""
    guide, how = ((a + b) / 2, variance), Filter(radius, patch, patch - 1)
    a, b = run(a, guide, how).image, run(b, guide, how).image
    return Feature((a + b) / 2, blurred((a - b) ** 2 / 4), unit)


@dataclass(frozen=True)
class Numbers:
    """Radii and thresholds of the whole method."""

    window: int = 10
    patches: tuple[int, int] = (1, 3)
    patch: int = 3
    k: float = 0.45
    k_feature: float = 0.6
    tau: float = 1e-3
    third_tau: float = 1e-4
    error_window: int = 1
    selection_window: int = 5
    second_window: int = 5
    second_tau: float = 1e-4
    step: float = 0.01
    guarded: bool = True


class Steps(NamedTuple):
    color: Array
    errors: Array
    shares: Array
    mix: Array


def rdfc(a: Array, b: Array, variance: Array, features: Sequence[Feature], n: Numbers) -> Steps:
    """Run RDFC on two halves (H, W, 3), the variance of their mean, and filtered features."""
    color = (a + b) / 2
    guide = (color, variance)
    candidates = [
        Filter(n.window, n.patches[0], 0, n.k, n.k_feature, n.tau),
        Filter(n.window, n.patches[1], 0, n.k, n.k_feature, n.tau),
        Filter(n.window, None, 0, n.k, n.k_feature, n.third_tau),
    ]
    halves, errors, slopes = [], [], []
    for how in candidates:
        pair = [run(half, guide, how, features).image for half in (a, b)]
        slope = derivative(color, variance, how, features, n.step)
        sure = ((pair[0] + pair[1]) / 2 - color) ** 2 + 2 * variance * slope - variance
        halves.append(pair)
        slopes.append(slope.mean(-1))
        errors.append(
            run(sure.mean(-1)[..., None], guide, Filter(n.error_window, n.patch, n.patch - 1)).image[..., 0]
        )
    maps = np.zeros((*color.shape[:2], 3))
    for y in range(color.shape[0]):
        for x in range(color.shape[1]):
            best, least = 2, errors[2][y, x]
            if errors[1][y, x] < least:
                best, least = 1, errors[1][y, x]
            allowed = not n.guarded or slopes[0][y, x] <= slopes[1][y, x]
            if allowed and errors[0][y, x] < least:
                best = 0
            maps[y, x, best] = 1
    select = Filter(n.selection_window, n.patch, n.patch - 1)
    shares = np.stack(
        [run(maps[..., i : i + 1], guide, select).image[..., 0] for i in range(3)],
        -1,
    )
    shares /= shares.sum(-1, keepdims=True)
    mixed = [sum(shares[..., i, None] * halves[i][side] for i in range(3)) for side in range(2)]
    mix = np.asarray((mixed[0] + mixed[1]) / 2)
    left = blurred((mixed[0] - mixed[1]) ** 2 / 4)
    second = Filter(n.second_window, n.patch, n.patch - 1, n.k, n.k_feature, n.second_tau, True)
    both = [run(half, (mix, left), second, features).image for half in mixed]
    return Steps(np.asarray((both[0] + both[1]) / 2), np.stack(errors, -1), shares, mix)
