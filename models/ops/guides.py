"""Auxiliary buffers as AFGSA, ACFM and KPCN read them: finite, of a known range, whatever a renderer wrote.

Source: the code of AFGSA's authors (Yu et al. 2021, doi:10.1145/3478513.3480565), whose preprocessing is also
ACFM's and KPCN's: what is no number is 0, normals are brought to [0, 1], depth is divided by the largest of
the image, diffuse light by albedo + 0.00316. Two things differ: infinite depth is 0 (the vocabulary's "no
hit") instead of the largest number, beside which all other depth would vanish; and an albedo that is no
number divides light by 1 instead of 0.00316.
"""

from __future__ import annotations

import torch
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.precision import wide

ALBEDO_OFFSET = 0.00316
"""Added to the albedo before light is divided by it or multiplied with it."""


def finite(image: Tensor, otherwise: float = 0.0) -> Tensor:
    """Return the image in float32 or wider, with a number where it is infinite or none."""
    return torch.nan_to_num(wide(image), otherwise, otherwise, otherwise)


def unit_normal(normal: Tensor) -> Tensor:
    """Return (normal + 1) / 2, clipped to [0, 1]; what is no number counts as 0."""
    return (torch.nan_to_num(wide(normal), 0.0, 1.0, -1.0) * 0.5 + 0.5).clamp(0.0, 1.0)


def depth_range(depth: Tensor) -> Tensor:
    """Return the smallest and the largest depth (B, 2) of whole frames (B, N, H, W); nothing is below 0."""
    if not exporting() and depth.shape[1] > 1:  # of many samples, one at a time
        each = torch.stack([depth_range(part) for part in depth.split(1, 1)])
        return torch.stack([each[..., 0].amin(0), each[..., 1].amax(0)], 1)
    clean = _distance(depth.detach())
    return torch.stack([clean.amin((1, 2, 3)), clean.amax((1, 2, 3))], 1)


def farthest(depth: Tensor, given: Tensor | None) -> Tensor:
    """Return what depth is divided by, (B, 1, 1, 1): the largest of the frame.

    It is infinite where a frame has no depth, so that what is divided by it becomes 0.

    Args:
        depth: (B, 1, H, W).
        given: `depth_range` (B, 2) of the whole frame, or None: that of this image.
    """
    bounds = depth_range(depth) if given is None else wide(given)
    largest = bounds[:, 1, None, None, None].to(wide(depth).dtype)
    return torch.where(largest > 0, largest, torch.inf)


def relative_depth(depth: Tensor, given: Tensor | None) -> Tensor:
    """Return depth (B, 1, H, W) divided by `farthest`: [0, 1], and 0 everywhere in a frame without depth."""
    return _distance(depth) / farthest(depth, given)


def divisor(albedo: Tensor) -> Tensor:
    """Return what diffuse light is divided by, albedo + 0.00316: positive and finite."""
    return finite(albedo, 1.0).clamp_min(0.0) + ALBEDO_OFFSET


def _distance(depth: Tensor) -> Tensor:
    return finite(depth).clamp_min(0.0)
