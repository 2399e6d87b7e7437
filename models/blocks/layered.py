"""Layers of samples: what they hold, and what becomes of them (Munkberg and Hasselgren 2020)."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


class Layered(NamedTuple):
    """What becomes of the layers (figure 5 of the paper).

    Attributes:
        unfiltered: Radiance that was sorted into each layer, linear, (B, L, 3, H, W); their sum is the mean
            of the samples, clipped as networks see them.
        filtered: Filtered radiance of each layer, weighted by alpha; with weighted layers, what it adds to
            the image.
        alpha: Opacity of each layer (B, L, 1, H, W); with weighted layers, its share of the weights.
        color: The composite (B, 3, H, W). That of `Optimized` has coarser levels in it, while `filtered` and
            `alpha` are those of the finest.
    """

    unfiltered: Tensor
    filtered: Tensor
    alpha: Tensor
    color: Tensor

    def named(self) -> dict[str, Tensor]:
        """Return `layer0_unfiltered`, `layer0_alpha`, `layer0_filtered`, `layer1_unfiltered` …, from front to
        back, (B, 3 or 1, H, W)."""
        made = {}
        for layer in range(self.alpha.shape[1]):
            for what in ("unfiltered", "alpha", "filtered"):
                made[f"layer{layer}_{what}"] = getattr(self, what)[:, layer]
        return made


class Sorted(NamedTuple):
    """What layers hold: radiance (B, L, 3, H, W), weight (B, L, 1, H, W), embedding (B, L, E, H, W)."""

    radiance: Tensor
    weight: Tensor
    embedding: Tensor


class Composite(NamedTuple):
    """Filtered radiance and alpha of each layer, and the image; see `Layered`."""

    filtered: Tensor
    alpha: Tensor
    color: Tensor


def occupancy(weight: Tensor) -> Tensor:
    """Return the weights of each layer and those behind it, summed: (B, L, 1, H, W) of the same."""
    last, *front = weight.unbind(1)[::-1]
    behind = [last]
    for layer in front:
        behind.append(behind[-1] + layer)
    return torch.stack(behind[::-1], 1)


def smaller(layers: Sorted, factor: int) -> Sorted:
    """Return layers of which factor x factor pixels are averaged."""
    if factor == 1:
        return layers
    made = (F.avg_pool2d(part.flatten(0, 1), factor) for part in layers)
    return Sorted(*(m.reshape(*p.shape[:2], *m.shape[1:]) for m, p in zip(made, layers, strict=True)))
