"""Splats of samples that come one after another, with the largest logit of the pixel that splats.

    out(p + q) += sum_n exp(logit_q(n, p) - max_{n,q} logit_q(n, p)) values(n, p)

Source: the splat of SampleSplat in Munkberg and Hasselgren 2020 (doi:10.1111/cgf.14049). All samples of a
pixel that go to the same neighbour are added up before any is moved, C x K x K sums per pixel whatever the
number of samples. Where a sample brings a larger logit the sums are scaled down. `models.ops.splat` does the
same for all samples at once, with gradients; this form is for inference with many samples.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.ops.precision import wide
from models.ops.splat import source_maximum, splat


class Outgoing(NamedTuple):
    """What every pixel sends, divided by exp(maximum); without gradients.

    Attributes:
        taps: Weighted values for each neighbour, in the order of `splat`, (B, C, K * K, H, W).
        maximum: Largest logit so far (B, 1, 1, H, W).
    """

    taps: Tensor
    maximum: Tensor

    def arrived(self, size: int, beyond: bool = False) -> Tensor:
        """Return what arrives at every pixel, (B, C, H or H + K - 1, W); see `splat`."""
        batch, channels, _, height, width = self.taps.shape
        weights = self.taps.reshape(batch * channels, 1, -1, height, width)
        nothing = weights.new_empty(batch * channels, 1, 0, height, width)
        made = splat(nothing, weights, size, beyond).weight
        return made.reshape(batch, channels, *made.shape[-2:])


def send(sums: Outgoing | None, values: Tensor, logits: Tensor) -> Outgoing:
    """Add samples to what pixels send.

    Args:
        sums: Of the samples before, overwritten; None: there are none.
        values: (B, N, C, H, W).
        logits: (B, N, K * K, H, W), overwritten.
    """
    values, logits = wide(values), wide(logits)
    maximum = source_maximum(logits)
    if sums is None:
        batch, _, channels = values.shape[:3]
        taps = logits.new_zeros(batch, channels, *logits.shape[2:])
    else:
        maximum = torch.maximum(sums.maximum, maximum)
        taps = sums.taps.mul_(torch.exp(sums.maximum - maximum))
    weights = logits.sub_(maximum).exp_()
    for number in range(values.shape[1]):
        for channel in range(values.shape[2]):
            taps[:, channel].addcmul_(weights[:, number], values[:, number, channel, None])
    return Outgoing(taps, maximum)
