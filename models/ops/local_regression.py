"""Weighted local regression in a reduced feature space, with estimated bandwidths: the steps of WLR.

For every pixel p, over its window (pixels outside the image take no part), with z the features of q, position
included, divided by their largest deviation from the window's mean:

    reduce      U: the eigenvectors of the scatter of z whose singular value exceeds what noise of the
                features explains; t_q = U^T (z_q - z_p)
    shape       a quadratic in t is fitted with the kernel K(t) = prod_i 0.75 max(0, 1 - t_i^2);
                b_i = 1 / sqrt(H_i + 0.16), H_i = 2 |coefficient of t_i^2|, mean of the channels
    fit         a linear function of t, with the weights K(t / (h b)): its value at p is sum_q l_q c_q
    bandwidth   bias of the fit = a_0 + a_1 h^2 and variance sum_q l_q^2 V_q = c_0 + c_1 h^-r, fitted over the
                trials h; their sum of squares is least at h^(r + 4) = r c_1 / (4 a_1^2)

(Moon et al. 2014, see `models.classical.wlr`.) The last step works on the variance itself, so that the number
of samples, which stands on both sides there, cancels.

A ridge keeps slopes finite. The constant has none, so that the l_q add up to 1 and a constant image stays
constant. Windows are cut out whole for some pixels at a time, as many as the budget allows: all seven fits of
a pixel then share its coordinates. Compiled kernels do the same pixel by pixel, with no more directions than
are kept and no more neighbours than a trial reaches (`models.ops.fused.local`). Everything is in float64:
kernels end abruptly, and a neighbour must not come and go with the rounding of its coordinates.

U is taken as given where gradients are computed; eigenvectors have none where eigenvalues are equal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.feature_windows import Noisy, Stack, Windows, in_blocks
from models.ops.nlm import use_fused
from models.ops.shared_bandwidth import shared_bandwidth, smoothed

_BUDGET = {"cpu": 64e6}
_BUDGET_ELSEWHERE = 4e9
_TINY = 1e-200


@dataclass(frozen=True)
class LocalRule:
    """The numbers of the method; names and meanings as in `models.classical.wlr.WLR`."""

    window: int = 9
    trials: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)
    least_bandwidth: float = 0.01
    map_sigma: float = 1.0
    least_scale: float = 0.01
    noise_factor: float = 2.0
    least_singular: float = 0.01
    least_curvature: float = 0.16
    quadratic_ridge: float = 1e-3
    ridge: float = 1e-4
    color_factor: float = 3.0
    color_floor: float = 0.005

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: Names what is out of range.
        """
        if self.window < 1:
            raise ValueError(f"local regression needs a window radius of at least 1, got {self.window}")
        if len(set(self.trials)) < 2 or not all(0 < h < math.inf for h in self.trials):
            raise ValueError(f"local regression needs at least two bandwidths > 0 to try, got {self.trials}")
        if not 0 < self.least_bandwidth <= 1:
            raise ValueError(f"least_bandwidth must be above 0 and at most 1, got {self.least_bandwidth}")
        for name in ("least_scale", "least_curvature", "quadratic_ridge", "ridge"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("map_sigma", "noise_factor", "least_singular", "color_factor", "color_floor"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")

    @property
    def map_reach(self) -> int:
        """Radius of the Gaussian that smooths bandwidths."""
        return math.ceil(3 * self.map_sigma)


class Fitted(NamedTuple):
    """What was fitted.

    Attributes:
        color: (B, 3, H, W).
        bandwidth: The shared bandwidth h, (B, 1, H, W) in [0.01, 1].
        rank: Dimensions of the reduced space, (B, 1, H, W).
    """

    color: Tensor
    bandwidth: Tensor
    rank: Tensor


class Space(NamedTuple):
    """The reduced space of P pixels.

    Attributes:
        axes: Times features relative to the pixel these are coordinates, (P, D, D); 0 for what is cut off.
        kept: 1 for each coordinate that is not cut off, (P, D).
    """

    axes: Tensor
    kept: Tensor


def local_regression(
    color: Noisy,
    features: Sequence[Noisy],
    rule: LocalRule,
    budget: float | None = None,
    *,
    fused: bool | None = None,
) -> Fitted:
    """Fit every pixel.

    Pixels whose colour, variance or features are not finite are no neighbours. They get the value of the fit
    around them, or the mean of their window where there is none, or 0.

    Args:
        color: Radiance and the variance of its mean.
        features: Each is scaled as one vector.
        rule: The numbers of the method.
        budget: Working memory in bytes beside inputs and results; None: 64 MB on a CPU, 4 GB elsewhere.
        fused: See `models.ops.nlm.use_fused`; float64 is no hindrance here.
    """
    stack = Stack(color, features, rule.window)
    tensors = (part for noisy in (color, *features) for part in noisy)
    if use_fused(fused, *tensors, kinds=(torch.float32, torch.float64)):
        from models.ops.local_bands import banded_regression

        found = banded_regression(stack, rule, _BUDGET["cpu"] if budget is None else budget)
        return Fitted(*(x.to(color.image.dtype) for x in found))
    pixels = 0 if exporting() else _pixels(stack, color.image.device, budget)
    axes, kept, shape, shared = in_blocks(
        lambda *block: _estimated(stack.windows(*block), rule), stack.size[1:], pixels
    )
    smooth = smoothed(shared.permute(0, 3, 1, 2), rule.map_sigma, rule.map_reach)

    def last(rows: slice, columns: slice) -> tuple[Tensor, ...]:
        windows, parts = stack.windows(rows, columns), (axes, kept, shape, smooth.permute(0, 2, 3, 1))
        own_axes, own_kept, own_shape, h = (x[:, rows, columns].flatten(0, 2) for x in parts)
        near = neighbours(windows, Space(own_axes, own_kept), own_shape, rule)
        return (windows.maps(fitted(windows, near, h, rule)[0]),)

    (image,) = in_blocks(last, stack.size[1:], pixels)
    rank = kept.sum(-1, keepdim=True).permute(0, 3, 1, 2)
    results = (image.permute(0, 3, 1, 2), smooth, rank)
    return Fitted(*(x.to(color.image.dtype) for x in results))


def _pixels(stack: Stack, device: torch.device, budget: float | None) -> int:
    """Return how many pixels of each image fit a budget, at least 1."""
    if budget is None:
        budget = _BUDGET.get(device.type, _BUDGET_ELSEWHERE)
    # Copies of a window: features, colours, coordinates, squares, regressors, the same weighted, weights.
    numbers = (2 * stack.window + 1) ** 2 * (13 * stack.dimensions + 40)
    return max(1, int(budget / (8 * numbers * stack.size[0])))


def _estimated(windows: Windows, rule: LocalRule) -> tuple[Tensor, ...]:
    """Return maps of axes, kept axes, the bandwidths b and the shared bandwidth h."""
    space = reduced(windows, rule)
    shape = (curvature(windows, space, rule) + rule.least_curvature).rsqrt()
    near = neighbours(windows, space, shape, rule)
    outputs = [fitted(windows, near, torch.full_like(shape[:, :1], h), rule) for h in rule.trials]
    bias = torch.stack([(color - windows.own).mean(-1) for color, _ in outputs])
    variance = torch.stack([v for _, v in outputs])
    shared = shared_bandwidth(rule.trials, bias, variance, space.kept.sum(-1), rule.least_bandwidth)
    return tuple(windows.maps(x) for x in (*space, shape, shared[:, None]))


@torch.no_grad()
def reduced(windows: Windows, rule: LocalRule) -> Space:
    """Cut off the directions that noise explains; at least two stay.

    A singular value counts as noise up to least_singular + noise_factor * 2 |E| / sqrt(D), |E| being the root
    of the summed variances of the scaled features of the window.
    """
    relative, inside = windows.relative, windows.inside
    mean = (relative * inside).sum(-1, keepdim=True) / inside.sum(-1, keepdim=True).clamp_min(1.0)
    deviation = (relative - mean) * inside
    size = sum(windows.groups)
    farthest = [
        part.square().sum(1).amax(-1).sqrt().clamp_min(rule.least_scale)
        for part in deviation.split(list(windows.groups), 1)[2:]
    ]
    position = torch.full_like(windows.own[:, :2], float(rule.window))
    parts = [f[:, None].expand(-1, n) for f, n in zip(farthest, windows.groups[2:], strict=True)]
    scale = torch.cat([position, *parts], -1)
    # Scaled after the sums: those of positions are whole numbers then, and where features are constant the
    # axes are exactly right and down, not some rotation of them that rounding chose.
    scatter = deviation @ deviation.transpose(1, 2) / (scale[:, :, None] * scale[:, None])
    values, vectors = torch.linalg.eigh(scatter)
    squares = torch.stack(farthest, -1).square() if farthest else windows.noise
    error = ((windows.noise / squares).sum(-1, keepdim=True) / size).sqrt()
    limit = rule.least_singular + rule.noise_factor * 2 * error
    kept = values.clamp_min(0.0).sqrt() > limit
    always = torch.arange(size, device=kept.device) >= size - 2  # values ascend
    kept = (kept | always).to(scale.dtype)
    return Space((vectors / scale[:, :, None] * kept[:, None]).transpose(1, 2), kept)


class Neighbours(NamedTuple):
    """The N neighbours of P pixels in the reduced space.

    Attributes:
        regressors: 1 and the coordinates, (P, 1 + D, N).
        squares: Squared coordinates in units of their bandwidths b, (P, D, N); 0 where cut off.
        weight: What neighbours weigh before the kernel, (P, N).
    """

    regressors: Tensor
    squares: Tensor
    weight: Tensor


def neighbours(windows: Windows, space: Space, shape: Tensor, rule: LocalRule) -> Neighbours:
    """Return the neighbours that colour lets pass, with bandwidths b (P, D)."""
    t = space.axes @ windows.relative
    weight = admitted(windows, rule) / windows.variance[:, 0].clamp_min(1.0)
    factors = _factors(space.kept)
    return Neighbours(_with_constant(t), (t / shape[:, :, None]).square(), weight * factors)


def epanechnikov(squares: Tensor) -> Tensor:
    """Return prod_i max(0, 1 - squares_i), (P, N), of (P, D, N)."""
    first, *others = (1 - squares).clamp_min(0.0).unbind(1)
    for factor in others:
        first = first * factor
    return first


def curvature(windows: Windows, space: Space, rule: LocalRule) -> Tensor:
    """Return |second derivative| of the colours along each coordinate, mean of the channels, (P, D)."""
    t = space.axes @ windows.relative
    squares = t.square()
    weights = epanechnikov(squares) * (windows.inside[:, 0] * _factors(space.kept))
    x = torch.cat([_with_constant(t), squares], 1)
    weighted = weights[:, None] * x
    right = weighted @ windows.color.transpose(1, 2)
    coefficients = _solved(x, weighted, right, rule.quadratic_ridge)
    return 2 * coefficients[:, 1 + t.shape[1] :].abs().mean(-1)


def fitted(windows: Windows, near: Neighbours, h: Tensor, rule: LocalRule) -> tuple[Tensor, Tensor]:
    """Fit a linear function of the coordinates and return its value at the pixel (P, 3) and variance (P,).

    Args:
        windows: Colours and their variance.
        near: The neighbours.
        h: Shared bandwidth (P, 1).
        rule: The numbers of the method.
    """
    weights = epanechnikov(near.squares / h[:, :, None].square()) * near.weight
    alone = (weights > 0).sum(-1) <= 1
    weighted = weights[:, None] * near.regressors
    first = torch.zeros_like(weighted[:, :, :1])
    first[:, 0] = 1.0
    row = _solved(near.regressors, weighted, first, rule.ridge).transpose(1, 2) @ weighted
    color = (row * windows.color).sum(-1)
    positive = row.clamp_min(0.0)
    positive = positive / positive.sum(-1, keepdim=True).clamp_min(_TINY)
    row = torch.where((color < 0).any(-1)[:, None, None], positive, row)
    color, variance = (row * windows.color).sum(-1), (row.square() * windows.variance).sum(-1)
    own = windows.variance[..., windows.variance.shape[-1] // 2]
    return torch.where(alone[:, None], windows.own, color), torch.where(alone, own[:, 0], variance[:, 0])


def admitted(windows: Windows, rule: LocalRule) -> Tensor:
    """Return 1 for neighbours whose difference noise explains, (P, N); all where the own is not known."""
    grey, spread = windows.color.mean(1), windows.variance[:, 0].sqrt()
    middle = grey.shape[1] // 2
    limit = rule.color_factor * (spread + spread[:, middle : middle + 1]) + rule.color_floor
    alike = (grey - grey[:, middle : middle + 1]).abs() <= limit
    return windows.inside[:, 0] * (alike | ~windows.known)


def _with_constant(t: Tensor) -> Tensor:
    return torch.cat([torch.ones_like(t[:, :1]), t], 1)


def _factors(kept: Tensor) -> Tensor:
    """Return the constant factors of the kernel, (P, 1)."""
    return torch.full_like(kept[:, :1], 0.75).pow(kept.sum(-1, keepdim=True))


def _solved(x: Tensor, weighted: Tensor, right: Tensor, ridge: float) -> Tensor:
    """Solve (X W X^T + ridge) b = right, the constant, which comes first, without a ridge."""
    normal = weighted @ x.transpose(1, 2)
    slopes = torch.full_like(normal[0, 0], ridge)
    slopes[0] = 0.0
    nothing = (normal[:, :1, :1] <= 0).to(normal.dtype)  # no neighbour at all: keeps the matrix regular
    constant = torch.zeros_like(normal[0])
    constant[0, 0] = 1.0
    factor = torch.linalg.cholesky_ex(normal + torch.diag(slopes) + nothing * constant).L
    return torch.cholesky_solve(right, factor)
