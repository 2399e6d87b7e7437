"""Softmax over everything that reaches a pixel, for samples that come one after another.

    out(p) = sum_{n,q} exp(logit_q(n, p - q)) values(n, p - q) / (sum_{n,q} exp(logit_q(n, p - q)) + eps)

Source: the splat of Gharbi et al. 2019 (doi:10.1145/3306346.3322954), section 4.3. The largest logit that has
reached a pixel is kept beside the sums; whenever a sample brings a larger one the sums are scaled down, so the
result is that of all samples at once, and nothing that grows with their number is kept. The gather of the
paper's ablation, where pixels choose among their neighbours instead, is accumulated in the same way.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from models.ops import kernel_graph as graph
from models.ops.boxes import exporting
from models.ops.gather import gather
from models.ops.kernel_blocks import arriving_maximum
from models.ops.precision import wide
from models.ops.splat import splat_shifted

Outside = Literal["weigh", "drop"]
"""Offsets from outside the image: they take weight with logit 0 and value 0 (SBMC), or do not exist."""

EPSILON = 1e-8

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
    return add_splat(None, values, logits, size, outside).mean()


def add_splat(
    before: Arrivals | None, values: Tensor, logits: Tensor, size: int, outside: Outside = "weigh"
) -> Arrivals:
    """Add samples to the sums; see `splat_softmax`.

    Args:
        before: Sums so far, None at the first samples.
        values: (B, N, C, H, W), usually N = 1.
        logits: (B, N, K * K, H, W).
        size: K, odd.
        outside: The same in every call.
    """
    beyond = _beyond(logits, size) if outside == "weigh" else None
    maximum = _maximum(logits.detach(), size, beyond)
    if before is not None:
        maximum = torch.maximum(maximum, before.maximum)
    sums = splat_shifted(values, logits, size, maximum)
    weight = sums.weight
    if beyond is not None:
        weight = weight + logits.shape[1] * beyond * torch.exp(-maximum)
    return _joined(before, Arrivals(sums.total, weight, maximum))


def add_gather(before: Arrivals | None, values: Tensor, logits: Tensor, size: int) -> Arrivals:
    """Add one sample, of which every pixel gathers with its own kernel; outside the image is black.

    Args:
        before: Sums so far, None at the first sample.
        values: (B, C, H, W).
        logits: (B, K * K, H, W), in the order of `models.ops.gather`.
        size: K, odd.
    """
    level = torch.logsumexp(wide(logits), 1, keepdim=True)
    maximum = level.detach() if before is None else torch.maximum(level.detach(), before.maximum)
    weight = torch.exp(level - maximum)
    return _joined(before, Arrivals(gather(values, logits, size, "zero") * weight, weight, maximum))


def _joined(before: Arrivals | None, now: Arrivals) -> Arrivals:
    if before is None:
        return now
    scale = torch.exp(before.maximum - now.maximum)
    return Arrivals(before.total * scale + now.total, before.weight * scale + now.weight, now.maximum)


def _maximum(logits: Tensor, size: int, beyond: Tensor | None) -> Tensor:
    if exporting():
        return graph.arriving_maximum(wide(logits), size, _NEVER if beyond is None else 0.0)
    largest = wide(arriving_maximum(logits, size))
    return largest if beyond is None else torch.where(beyond > 0, largest.clamp_min(0.0), largest)


def _beyond(logits: Tensor, size: int) -> Tensor:
    """Return how many of a pixel's K * K neighbours lie outside the image, (1, 1, H, W)."""
    image = wide(torch.ones_like(logits[:1, :1, 0]))
    if exporting():
        return graph.outside_count(image, size)
    inside = []
    for axis in (-2, -1):
        length, reach = image.shape[axis], size // 2
        place = torch.arange(length, device=image.device)
        inside.append((place + reach).clamp_max(length - 1) - (place - reach).clamp_min(0) + 1)
    return (size * size - inside[0][:, None] * inside[1]).to(image.dtype)[None, None]
