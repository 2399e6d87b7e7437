"""Collaborative first-order regression with weights that stream over window offsets.

Around every pixel p a linear model of position and features is fitted to the window,

    minimise over b:  sum_q w(p, q) | y_q - b_0 - b_xy . (q - p) - b_f . (f_q - f_p) |^2,

every pixel of the window is predicted by the fitted model, and predictions are averaged with the same
weights over all windows that hold the pixel (equation 12 and section 5.2 of NFOR, `models.classical.nfor`).

Per offset the products of w, the regressors and the colours are added to images of sums, the normal
equations, of which the symmetric half is kept; they are solved for all pixels at once, one matrix entry being
one image; then predictions are added offset by offset. Working memory is a strip of rows and its weights.

The solver. Regressors are centred on p, so that sums do not cancel. The constant is eliminated first, which
leaves covariances. These get a ridge on the diagonal: `RIDGE` times the second moment of each regressor,
which does not depend on the units of a feature, plus the square of `NOISE` times the feature's value at p:
smaller differences are rounding. Constant, repeated and collinear features thus have finite coefficients,
and predict what a rank-revealing factorisation predicts up to about the ridge. The constant has no ridge, so
a constant image stays constant. Sums are kept in the precision of the inputs and factorised in float64.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import EllipsisType

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.nlm import Guide, Offset, PatchKernel, PatchWeights, guide_parts, strips, use_fused

RIDGE = 5e-7
NOISE = 2e-6
_TOGETHER = 16
"""Offsets whose products are added in the precision of the images before float64 takes over: added one by
one, 361 float32 numbers lose as many digits as the ridge leaves."""

_TINY = 1e-30
Place = tuple[EllipsisType, slice, slice]
_POSITIONS = 3
"""Regressors beside the constant and the features: rows, columns, frames."""


@dataclass(frozen=True)
class Sample:
    """What one frame contributes to the windows.

    Attributes:
        image: What is fitted, (B, 3, H, W).
        features: (B, K, H, W), K >= 0.
        guide: What the weights are made from.
    """

    image: Tensor
    features: Tensor
    guide: Guide


def collaborative_regression(
    frames: Sequence[Sample],
    kernel: PatchKernel,
    reach: int = 0,
    budget: float | None = None,
    *,
    fused: bool | None = None,
) -> list[list[Tensor]]:
    """Fit and predict all windows.

    Args:
        frames: One for a still, or consecutive ones.
        kernel: Gives one weight for all channels (`least` or `mean`), for any number of bandwidths.
        reach: Frames before and after its own that a window spans; the frame index is a regressor then.
        budget: Working memory in bytes beside inputs and results; see `models.ops.nlm.strips`.
        fused: See `models.ops.nlm.use_fused`.

    Returns:
        For each bandwidth and frame the image (B, 3, H, W).
    """
    tensors = [part for f in frames for part in (f.image, f.features, *f.guide)]
    if use_fused(fused, *tensors):
        return [_regress_fused(frames, kernel, k, reach) for k in kernel.bandwidths]
    batch, _, height, width = frames[0].image.shape
    window, count = kernel.window, len(kernel.bandwidths)
    joined = [torch.cat([f.features, f.image], 1) for f in frames]
    padded = [F.pad(j, [window] * 4) for j in joined]
    shape = (batch, 4, height + 2 * window, width + 2 * window)
    totals = [[joined[0].new_zeros(shape) for _ in frames] for _ in range(count)]
    row_bytes = batch * width * frames[0].image.element_size() * _numbers(frames, kernel, reach)
    for centre in range(len(frames)):
        near = range(max(0, centre - reach), min(len(frames), centre + reach + 1))
        weights = PatchWeights([frames[i].guide for i in near], kernel, centre - near[0])
        for rows in [(0, height)] if exporting() else strips(height, row_bytes, budget, joined[0].device):
            strip = _Strip([padded[i] for i in near], centre - near[0], rows, window)
            _regress(strip, weights, [[totals[k][i] for i in near] for k in range(count)])
    inner = (..., slice(window, window + height), slice(window, window + width))
    return [[t[inner][:, :3] / t[inner][:, 3:] for t in total] for total in totals]


def _numbers(frames: Sequence[Sample], kernel: PatchKernel, reach: int) -> int:
    """Return how many numbers a pixel of a strip takes: weights, sums, temporary images."""
    regressors = 1 + _POSITIONS + frames[0].features.shape[1]
    offsets = (2 * kernel.window + 1) ** 2 * min(len(frames), 2 * reach + 1)
    sums = regressors * (regressors + 1) // 2 + 3 * regressors
    return len(kernel.bandwidths) * (offsets + 3 * sums) + 3 * sums + 60


class _Strip:
    """Rows of one frame and their neighbours: padded features and colours of the frames around it."""

    def __init__(self, padded: Sequence[Tensor], centre: int, rows: tuple[int, int], window: int) -> None:
        self.padded, self.centre, self.rows, self.window = padded, centre, rows, window
        self.width = padded[0].shape[-1] - 2 * window
        own = self.there(Offset(0, 0, 0))[1]
        self.features = own[:, :-3]
        self.origin = torch.cat([self.features, torch.zeros_like(own[:, -3:])], 1)
        self.temporal = len(padded) > 1
        self.known = 4 if self.temporal else 3

    def there(self, offset: Offset) -> tuple[Place, Tensor]:
        """Return the neighbours' place in padded images, and their features and colours."""
        (start, stop), window = self.rows, self.window
        top, left = window + offset.down, window + offset.right
        place = (..., slice(top + start, top + stop), slice(left, left + self.width))
        return place, self.padded[self.centre + offset.frames][place]

    def regressors(self, offset: Offset) -> Tensor:
        """Return 1, position relative to p, features relative to p, and colours (B, R + 3, rows, W)."""
        relative = self.there(offset)[1] - self.origin
        steps = [1.0, float(offset.down), float(offset.right)]
        steps += [float(offset.frames)] if self.temporal else []
        return torch.cat([relative[:, :1] * 0 + s for s in steps] + [relative], 1)


def _regress(strip: _Strip, weights: PatchWeights, totals: list[list[Tensor]]) -> None:
    """Add the predictions of the windows around a strip to the totals: weighted colours and weights."""
    kept = []
    sums: list[list[Tensor]] = [[] for _ in totals]
    for first in range(0, len(weights.offsets), _TOGETHER):
        parts: list[list[Tensor]] = [[] for _ in totals]
        for offset in weights.offsets[first : first + _TOGETHER]:
            z = strip.regressors(offset)
            of_offset = weights.at(offset, strip.rows)
            kept.append(of_offset)
            for weight, into in zip(of_offset, parts, strict=True):
                _add_products(into, weight * z[:, :-3], z)
        for into, part in zip(sums, parts, strict=True):
            wide = [rows.double() for rows in part]
            into[:] = [x.add_(y) for x, y in zip(into, wide, strict=True)] if into else wide
    models = [_solve(into, strip) for into in sums]
    del sums
    for offset, of_offset in zip(weights.offsets, kept, strict=True):
        place, _ = strip.there(offset)
        z = strip.regressors(offset)[:, :-3]
        for weight, model, total in zip(of_offset, models, totals, strict=True):
            predicted = (model * z[:, None]).sum(2)
            nearby = total[strip.centre + offset.frames][place]
            nearby += torch.cat([weight * predicted, weight], 1)


def _add_products(sums: list[Tensor], weighted: Tensor, z: Tensor) -> None:
    """Add the products of weighted regressors with all later regressors and the colours."""
    first = not sums
    for i in range(weighted.shape[1]):
        if first:
            sums.append(weighted[:, i : i + 1] * z[:, i:])
        else:
            sums[i].addcmul_(weighted[:, i : i + 1], z[:, i:])


def _solve(sums: list[Tensor], strip: _Strip) -> Tensor:
    """Return the coefficients of the fitted models, (B, 3, R, rows, W)."""
    rows, size = sums, len(sums)
    total = rows[0][:, :1]
    mean = rows[0] / total
    known = strip.known
    # Covariances of regressors 1 … with each other and the colours; row i starts at column i.
    covariance = [rows[i] - rows[0][:, i : i + 1] * mean[:, i:] for i in range(1, size)]
    ridge = []
    for i in range(1, size):
        own = RIDGE * rows[i][:, :1] + _TINY * total
        if i >= known:
            own = own + total * (NOISE * strip.features[:, i - known : i - known + 1].double()).square()
        ridge.append(own)
    slopes = solve_covariances(covariance, ridge)
    constant = mean[:, size:]
    for i, slope in enumerate(slopes, 1):
        constant = constant - mean[:, i : i + 1] * slope
    return torch.stack([constant, *slopes], 2).to(strip.origin.dtype)


def solve_covariances(covariance: list[Tensor], ridge: list[Tensor]) -> list[Tensor]:
    """Solve (C + ridge) b = r by an LDL^T factorisation, one image per matrix entry.

    Args:
        covariance: Row i holds C_ii … C_in and the right-hand sides, (B, n - i + 3, rows, W).
        ridge: Added to C_ii, (B, 1, rows, W), positive. Pivots are at least this, as they would be without
            rounding.

    Returns:
        b_i for each i, (B, 3, rows, W).
    """
    size = len(covariance)
    work = list(covariance)
    pivots = []
    for j in range(size):
        pivot = torch.maximum(work[j][:, :1] + ridge[j], ridge[j])
        pivots.append(pivot)
        factors = work[j] / pivot
        for i in range(j + 1, size):
            work[i] = work[i] - factors[:, i - j : i - j + 1] * work[j][:, i - j :]
    return list(_back_substituted(work, pivots))


def _back_substituted(work: list[Tensor], pivots: list[Tensor]) -> Iterator[Tensor]:
    size = len(work)
    solution: list[Tensor] = []
    for j in reversed(range(size)):
        right = work[j][:, size - j :]
        for i, known in zip(range(size - 1, j, -1), solution, strict=True):
            right = right - work[j][:, i - j : i - j + 1] * known
        solution.append(right / pivots[j])
    return reversed(solution)


def _regress_fused(frames: Sequence[Sample], kernel: PatchKernel, k: float, reach: int) -> list[Tensor]:
    from models.ops import fused

    numbers = fused.Kernel.of(kernel, k, torch.get_num_threads())
    joined = torch.stack([torch.cat([f.features, f.image], 1) for f in frames])
    image, variance = (torch.stack(parts) for parts in guide_parts([f.guide for f in frames], kernel))
    batch, height, width = joined.shape[1], *joined.shape[-2:]
    totals = joined.new_zeros(len(frames), batch, 4, height, width)
    for centre in range(len(frames)):
        near = slice(max(0, centre - reach), min(len(frames), centre + reach + 1))
        for b in range(batch):
            parts = [stack[near, b].numpy() for stack in (joined, image, variance)]
            found = fused.regress(parts[0], parts[1], parts[2], numbers, centre - near.start, (RIDGE, NOISE))
            totals[near, b] += torch.from_numpy(found)
    return list((totals[:, :, :3] / totals[:, :, 3:]).unbind(0))
