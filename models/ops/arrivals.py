"""Softmax over everything that reaches a pixel, for samples that come one after another.

    out(p) = sum_{n,q} exp(logit_q(n, p - q)) values(n, p - q) / (sum_{n,q} exp(logit_q(n, p - q)) + eps)

Source: the splat of Gharbi et al. 2019 (doi:10.1145/3306346.3322954), section 4.3. The largest logit that has
reached a pixel is kept beside the sums. Whenever a sample brings a larger one the sums are scaled down, so
the result is that of all samples at once, and nothing that grows with their number is kept. The gather of the
paper's ablation, where pixels choose among their neighbours instead, is accumulated in the same way.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from models.ops import kernel_graph as graph
from models.ops.boxes import exporting
from models.ops.gather import gather_padded
from models.ops.kernel_blocks import arriving_maximum
from models.ops.precision import wide
from models.ops.splat import splat_shifted

Outside = Literal["weigh", "drop"]
"""Offsets from outside the image: they take weight with logit 0 and value 0 (SBMC), or do not exist."""

EPSILON = 1e-8

_HIGH = 60.0
"""Where there is nothing outside, exp of this stays finite and is multiplied by 0."""

_NEVER = -1e4
"""A logit that never matters, for graphs that cannot hold an infinity."""


class Arrivals(NamedTuple):
    """Sums over the samples so far, divided by exp(maximum).

    Attributes:
        total: Weighted values (B, C, H, W).
        weight: Weights (B, 1, H, W).
        maximum: Largest logit (B, 1, H, W), a constant for the gradient.
    """

    total: Tensor
    weight: Tensor
    maximum: Tensor

    def mean(self, epsilon: float = EPSILON) -> Tensor:
        """Return total / (weight + epsilon), (B, C, H, W)."""
        return self.total / (self.weight + epsilon)


def splat_softmax(values: Tensor, logits: Tensor, size: int, outside: Outside = "weigh") -> Tensor:
    """Return the mean of all that reaches a pixel, weighted by a softmax over samples and offsets.

    Args:
        values: (B, N, C, H, W), of N samples.
        logits: (B, N, K * K, H, W); map `K * (dy + r) + dx + r` is of what goes to the pixel dy rows below
            and dx columns to the right.
        size: K, odd.
        outside: What comes from outside the image.

    Returns:
        (B, C, H, W).

    Raises:
        ValueError: K is even, there are not K * K logits, or sizes differ.
    """
    sums = splatted(values, logits, size)
    if outside == "weigh":
        sums = with_outside(sums, size, values.shape[1])
    return sums.mean()


def splatted(values: Tensor, logits: Tensor, size: int, beyond: bool = False) -> Arrivals:
    """Return what some samples bring to every pixel; nothing comes from outside.

    Args:
        values: (B, N, C, H, W).
        logits: (B, N, K * K, H, W).
        size: K, odd.
        beyond: Return H + K - 1 rows: also those above and below the image that are reached.
    """
    if exporting():
        maximum = graph.arriving_maximum(wide(logits), size, _NEVER, beyond)
    else:
        maximum = wide(arriving_maximum(logits.detach(), size, beyond))
    return Arrivals(*splat_shifted(values, logits, size, maximum, beyond), maximum)


def gathered(values: Tensor, logits: Tensor, size: int) -> Arrivals:
    """Return what one sample contributes where every pixel gathers with its own kernel.

    Args:
        values: (B, C, H + K - 1, W + K - 1), with what lies around the image.
        logits: (B, K * K, H, W), in the order of `models.ops.gather`.
        size: K, odd.
    """
    level = torch.logsumexp(wide(logits), 1, keepdim=True)
    maximum = wide(logits.detach().amax(1, keepdim=True))
    weight = torch.exp(level - maximum)
    return Arrivals(gather_padded(values, logits, size) * weight, weight, maximum)


def merge(one: Arrivals, other: Arrivals) -> Arrivals:
    """Return the sums of both."""
    maximum = torch.maximum(one.maximum, other.maximum)
    first, second = torch.exp(one.maximum - maximum), torch.exp(other.maximum - maximum)
    total = one.total * first + other.total * second
    return Arrivals(total, one.weight * first + other.weight * second, maximum)


def together(parts: Arrivals) -> Arrivals:
    """Return the sums over samples whose sums are apart, (B, N, …, H, W)."""
    maximum = parts.maximum.amax(1)
    scale = torch.exp(parts.maximum - maximum[:, None])
    return Arrivals((parts.total * scale).sum(1), (parts.weight * scale).sum(1), maximum)


def with_outside(sums: Arrivals, size: int, samples: int) -> Arrivals:
    """Return sums to which all that is outside adds weight exp(0) for every offset and sample, and no value.

    Args:
        sums: Of all samples.
        size: K, odd.
        samples: Their number.
    """
    count = samples * _outside_count(sums.weight, size)
    maximum = torch.where(count > 0, sums.maximum.clamp_min(0.0), sums.maximum)
    scale = torch.exp(sums.maximum - maximum)
    weight = sums.weight * scale + count * torch.exp(-maximum.clamp_min(-_HIGH))
    return Arrivals(sums.total * scale, weight, maximum)


def _outside_count(image: Tensor, size: int) -> Tensor:
    """Return how many of each pixel's K * K neighbours lie outside images (B, 1, H, W)."""
    if exporting():
        return graph.outside_count(image, size)
    inside = []
    for axis in (-2, -1):
        length, reach = image.shape[axis], size // 2
        place = torch.arange(length, device=image.device)
        inside.append((place + reach).clamp_max(length - 1) - (place - reach).clamp_min(0) + 1)
    return (size * size - inside[0][:, None] * inside[1]).to(image.dtype)[None, None]
