"""Non-local means whose weights also look at feature buffers.

With features f of variance v, the bandwidth k and t = max(v, |grad f|^2, tau), per feature (the mean of its
channels)

    d_f(p, q) = mean of [(f_p - f_q)^2 - (v_p + min(v_p, v_q))] / (epsilon + k^2 (t_p + t_q)),

and a weight is the smallest of the colour's weight and exp(-max(0, d_f)) of every feature: Fabrice Rousselle,
Marco Manzi, Matthias Zwicker: "Robust Denoising using Feature and Color Information", Computer Graphics Forum
32(7), 2013, doi:10.1111/cgf.12219. The product of all of them is equations 8 and 9 of NFOR
(`models.classical.nfor`), whose bandwidth sigma_i,p^2 is k^2 (t_p + t_q) / 2 here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.nlm import Guide, Offset, PatchKernel, PatchWeights, strips, use_fused

EPSILON = 1e-10


@dataclass(frozen=True)
class Feature:
    """A filtered feature.

    Attributes:
        image: (B, C, H, W).
        variance: Of its values, (B, C, H, W).
        spread: t, the squared difference that counts as small, (B, C, H, W).
    """

    image: Tensor
    variance: Tensor
    spread: Tensor

    @classmethod
    def of(cls, image: Tensor, variance: Tensor, least: Tensor | float) -> Feature:
        """Return a feature with t = max(v, |grad f|^2, least)."""
        spread = torch.maximum(variance, squared_gradient(image))
        floor = least if isinstance(least, Tensor) else torch.full_like(spread, least)
        return cls(image, variance, torch.maximum(spread, floor))


def squared_gradient(image: Tensor) -> Tensor:
    """Return |grad f|^2 per channel, (B, C, H, W).

    The sum of a horizontal and a vertical part, each the smaller square of the two one-sided half
    differences, so that an edge counts on neither of its sides; 0 at the border.
    """
    # A repeated border makes one of its differences 0, which is the smaller square.
    padded = F.pad(image, [1] * 4, mode="replicate")
    down = (0.5 * padded[..., 1:-1].diff(dim=-2)).square()
    right = (0.5 * padded[..., 1:-1, :].diff(dim=-1)).square()
    smaller = torch.minimum(down[..., :-1, :], down[..., 1:, :])
    return smaller + torch.minimum(right[..., :-1], right[..., 1:])


@dataclass(frozen=True)
class JointKernel:
    """How colours and features are compared.

    Attributes:
        color: Gives one weight for all channels, for one bandwidth.
        bandwidth: k of the features.
        combine: `least` or `product`.
    """

    color: PatchKernel
    bandwidth: float = 0.6
    combine: Literal["least", "product"] = "least"


def joint_filter(
    images: Sequence[Tensor],
    guides: Sequence[Guide],
    features: Sequence[Feature],
    kernel: JointKernel,
    budget: float | None = None,
    *,
    fused: bool | None = None,
) -> list[Tensor]:
    """Filter images (B, C, H, W), each with the weights of its own guide and of all features.

    Args:
        images: What is filtered.
        guides: One for each image.
        features: Shared by all images.
        kernel: How weights are made.
        budget: Working memory in bytes, which sets the height of strips; see `models.ops.nlm.strips`.
        fused: See `models.ops.nlm.use_fused`.
    """
    parts = [x for f in features for x in (f.image, f.variance, f.spread)]
    if use_fused(fused, *images, *parts, *(x for guide in guides for x in guide)):
        pairs = zip(images, guides, strict=True)
        return [_filter_fused(image, guide, features, kernel) for image, guide in pairs]
    window = kernel.color.window
    height, width = images[0].shape[-2:]
    padded = [[F.pad(x, [window] * 4) for x in (f.image, f.variance, f.spread)] for f in features]
    frames = [F.pad(image, [window] * 4) for image in images]
    weights = [PatchWeights([guide], kernel.color) for guide in guides]
    row_bytes = images[0].element_size() * width * images[0].shape[0] * (60 + 20 * len(images))
    results: list[list[Tensor]] = [[] for _ in images]
    for rows in [(0, height)] if exporting() else strips(height, row_bytes, budget, images[0].device):
        totals: list[list[Tensor]] = [[] for _ in images]
        for offset in weights[0].offsets:
            distance = _feature_distance(padded, kernel, offset, (rows, width))
            for frame, of_color, total in zip(frames, weights, totals, strict=True):
                (weight,) = of_color.at(offset, rows)
                if distance is not None:
                    others = torch.exp(-distance)
                    weight = weight * others if kernel.combine == "product" else torch.minimum(weight, others)
                there = _place(window, offset, (rows, width))
                parts = [weight * frame[there], weight]
                total[:] = [x + y for x, y in zip(total, parts, strict=True)] if total else parts
        for result, (color, norm) in zip(results, totals, strict=True):
            result.append(color / norm)
    return [torch.cat(result, -2) for result in results]


def _filter_fused(image: Tensor, guide: Guide, features: Sequence[Feature], kernel: JointKernel) -> Tensor:
    from models.ops import fused

    (bandwidth,) = kernel.color.bandwidths
    rule = fused.Kernel.of(kernel.color, bandwidth, torch.get_num_threads())
    variance = guide.variance * kernel.color.scale
    maps = [
        torch.cat(parts, 1)
        for parts in zip(*((f.image, f.variance, f.spread) for f in features), strict=True)
    ]
    starts = np.cumsum([0, *(f.image.shape[1] for f in features)])
    numbers = np.array([kernel.bandwidth**2, EPSILON, kernel.combine == "product"], np.float32)
    result = []
    for b in range(image.shape[0]):
        of_b = torch.stack([m[b] for m in maps]).numpy() if maps else np.zeros((3, 0, 1, 1), np.float32)
        own, guides, variances = (x[b][None].numpy() for x in (image[:, None], guide.image, variance))
        joined = fused.FeatureMaps(of_b, starts, numbers)
        found = fused.filter_images(own, guides, variances, rule, features=joined)
        result.append(torch.from_numpy(found[0]))
    return torch.stack(result)


def _place(
    window: int, offset: Offset, strip: tuple[tuple[int, int], int]
) -> tuple[slice, slice, slice, slice]:
    ((start, stop), width), every = strip, slice(None)
    top, left = window + offset.down, window + offset.right
    return every, every, slice(top + start, top + stop), slice(left, left + width)


def _feature_distance(
    padded: Sequence[Sequence[Tensor]],
    kernel: JointKernel,
    offset: Offset,
    strip: tuple[tuple[int, int], int],
) -> Tensor | None:
    """Return the largest, or the sum, of the features' distances (B, 1, rows, W)."""
    window, squared = kernel.color.window, kernel.bandwidth**2
    total: Tensor | None = None
    for maps in padded:
        (f_p, v_p, t_p), (f_q, v_q, t_q) = (
            [m[_place(window, step, strip)] for m in maps] for step in (Offset(0, 0, 0), offset)
        )
        numerator = (f_p - f_q).square() - (v_p + torch.minimum(v_p, v_q))
        d = (numerator / (EPSILON + squared * (t_p + t_q))).mean(1, keepdim=True).clamp_min(0.0)
        if total is None:
            total = d
        else:
            total = total + d if kernel.combine == "product" else torch.maximum(total, d)
    return total
