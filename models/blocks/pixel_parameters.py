"""A small network at every pixel: statistics in, positive numbers out, as LBF predicts a filter's parameters.

Nima Khademi Kalantari, Steve Bako, Pradeep Sen: "A Machine Learning Approach for Filtering Monte Carlo
Noise", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766977: one hidden layer with the sigmoid, and
log(1 + exp(min(x, 10))) of what the second makes. Its input is normalised by numbers of the training set,
(x - mean) / (deviation + 1e-6).

Here these are measured in the first training step, before anything is learned: of the first batch, over all
processes of the training, and kept with the weights, so that a training that goes on keeps them. What hardly
varies in it is only shifted. Without a training the input stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

LIMIT = 10.0
"""Largest exponent of the output."""

_SMALL = 1e-6


class PixelParameters(nn.Module):
    """Two layers at every pixel.

    Args:
        seen: Channels of the statistics.
        hidden: Width of the hidden layer.
        starts: What the network begins with, positive: one for each number that it makes.
    """

    mean: Tensor
    deviation: Tensor
    measured: Tensor

    def __init__(self, seen: int, hidden: int, starts: Sequence[float]) -> None:
        super().__init__()
        self.first = nn.Conv2d(seen, hidden, 1)
        self.last = nn.Conv2d(hidden, len(starts), 1)
        assert self.last.bias is not None
        with torch.no_grad():
            self.last.weight.mul_(0.1)
            self.last.bias.copy_(torch.tensor([math.log(math.expm1(start)) for start in starts]))
        self.register_buffer("mean", torch.zeros(seen))
        self.register_buffer("deviation", torch.ones(seen))
        self.register_buffer("measured", torch.zeros((), dtype=torch.bool))

    def forward(self, statistics: Tensor) -> Tensor:
        """Return positive numbers (B, starts, H, W) from statistics (B, seen, H, W)."""
        if self.training and torch.is_grad_enabled() and not self.measured:
            self._measure(statistics.detach())
        mean, deviation = (x[:, None, None] for x in (self.mean, self.deviation))
        hidden = torch.sigmoid(self.first((statistics - mean) / (deviation + _SMALL)))
        return torch.log1p(torch.exp(self.last(hidden).clamp_max(LIMIT)))

    def _measure(self, statistics: Tensor) -> None:
        """Take mean and standard deviation from a batch, and from those of the other processes."""
        each = statistics.double().transpose(0, 1).flatten(1)
        sums = torch.stack([torch.ones_like(each).sum(1), each.sum(1), each.square().sum(1)])
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(sums)
        count, total, square = sums
        mean = total / count
        deviation = (square / count - mean.square()).clamp_min(0.0).sqrt()
        # A later value that differs would be divided by next to nothing otherwise.
        varies = deviation > _SMALL * mean.abs().clamp_min(_SMALL)
        self.mean.copy_(mean)
        self.deviation.copy_(torch.where(varies, deviation, 1.0))
        self.measured.fill_(True)
