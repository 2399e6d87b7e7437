"""Non-local means of feature groups, each with weights of its own, as LBF filters its features.

Nima Khademi Kalantari, Steve Bako, Pradeep Sen: "A Machine Learning Approach for Filtering Monte Carlo
Noise", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766977, released code: with a group's channels
f of variance v,

    d(p, q) = mean over channels of (f_p - f_q)^2 / (epsilon + v_p + v_q)
    w(p, q) = box mean of exp(-(mean of d(p + n, q + n) over the offsets n of a patch)),

no variance being subtracted. Values and variances are averaged with the same weights. Neighbours outside the
image take no part, and boxes lose the positions where one of the two pixels lies outside.

d(p, q) = d(q, p), and so are the means over boxes of pairs: one map of weights serves an offset and its
opposite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.nlm import Guide, strips
from models.ops.symmetric import Boxes
from models.pace import tick

EPSILON = 1e-10


@dataclass(frozen=True)
class GroupKernel:
    """Radii of the filter.

    Attributes:
        window: Of the window.
        patch: Of the patches that are compared.
        smoothing: Of the box that averages weights.
    """

    window: int = 5
    patch: int = 3
    smoothing: int = 2

    def __post_init__(self) -> None:
        """Check the radii."""
        if self.window < 1 or self.patch < 0 or self.smoothing < 0:
            raise ValueError(
                "the filter of features needs a window radius >= 1, patch and smoothing radii >= 0, got "
                f"{self.window}, {self.patch} and {self.smoothing}"
            )

    @property
    def reach(self) -> int:
        """How far a result looks from its pixel."""
        return self.window + self.patch + self.smoothing


def group_nlm(groups: Sequence[Guide], kernel: GroupKernel, budget: float | None = None) -> list[Guide]:
    """Filter groups of features and their variances.

    Args:
        groups: Each (B, C, H, W), of any C.
        kernel: Radii.
        budget: Working memory in bytes, which sets the height of strips; see `models.ops.nlm.strips`.
    """
    if not groups:
        return []
    sizes = [group.image.shape[1] for group in groups]
    joined = torch.cat([*(group.image for group in groups), *(group.variance for group in groups)], 1)
    height, width = joined.shape[-2:]
    row_bytes = joined.element_size() * joined.shape[0] * width * (8 * sum(sizes) + 10 * len(sizes))
    if exporting():
        found = _filtered(joined, sizes, kernel, 1.0)
    else:
        parts = []
        for start, stop in strips(height, row_bytes, budget, joined.device):
            top, bottom = max(0, start - kernel.reach), min(height, stop + kernel.reach)
            part = _filtered(joined[..., top:bottom, :], sizes, kernel, (stop - start) / height)
            parts.append(part[..., start - top : stop - top, :])
        found = torch.cat(parts, -2)
    images, variances = (part.split(sizes, 1) for part in found.chunk(2, 1))
    return [Guide(image, variance) for image, variance in zip(images, variances, strict=True)]


def _filtered(joined: Tensor, sizes: list[int], kernel: GroupKernel, share: float) -> Tensor:
    """Filter some rows as an image of their own; share: the part of the image that they are."""
    total, norm = joined.clone(), torch.ones_like(joined[:, : len(sizes)])
    parts = [slice(*ends) for ends in pairwise(accumulate(2 * sizes, initial=0))]
    height, width = joined.shape[-2:]
    for down in range(kernel.window + 1):
        for right in range(-kernel.window if down else 1, kernel.window + 1):
            tick(2 * share)
            if not exporting() and (down >= height or abs(right) >= width):
                continue
            one, other = _pair(down, right)
            p, q = joined[one], joined[other]
            weight = _weights(p, q, sizes, kernel)
            for side, neighbours in ((one, q), (other, p)):
                norm[side] += weight
                sums = total[side]
                for k, channels in enumerate(parts):
                    sums[:, channels].addcmul_(weight[:, k % len(sizes), None], neighbours[:, channels])
    return total / _each_channel(norm, sizes)


def _each_channel(maps: Tensor, sizes: list[int]) -> Tensor:
    """Return the map of its group for every channel, and again for every variance."""
    pairs = zip(maps.split(1, 1), sizes, strict=True)
    return torch.cat(2 * [part.expand(-1, size, -1, -1) for part, size in pairs], 1)


def _pair(down: int, right: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the pixels that have a neighbour at an offset, and these neighbours."""
    every = slice(None)
    above, below = slice(None, -down or None), slice(down, None)
    before, after = slice(None, -abs(right) or None), slice(abs(right), None)
    if right < 0:
        before, after = after, before
    return (every, every, above, before), (every, every, below, after)


def _weights(p: Tensor, q: Tensor, sizes: list[int], kernel: GroupKernel) -> Tensor:
    """Return the weights of pairs of pixels, (B, groups, h, w)."""
    (f_p, v_p), (f_q, v_q) = p.chunk(2, 1), q.chunk(2, 1)
    d = (f_p - f_q).square() / (EPSILON + v_p + v_q)
    each = torch.cat([part.mean(1, keepdim=True) for part in d.split(sizes, 1)], 1)
    boxes = Boxes(each)
    return boxes.mean(torch.exp(-boxes.mean(each, kernel.patch)), kernel.smoothing)
