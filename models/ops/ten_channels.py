"""The ten channels that WSKP reads, and with it the networks that its paper compares it with.

Tone-mapped colour 3, albedo 3, normal 3, depth 1, all in [0, 1]: section 5.1 of Fan et al. 2021
(doi:10.1111/cgf.14338), with the ranges of the authors' code. Depth is scaled by minimum and maximum of the
whole frame; a frame of constant depth, where the code divides 0 by 0, gives 0.

MR-KP in the code of Meng et al. 2020 (doi:10.2312/sr.20201133) sees the irradiance as it is instead of the
tone-mapped colour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from models.ops.precision import wide

FEATURES = 10
"""Channels: tone-mapped colour 3, albedo 3, normal 3, depth 1."""

BRIGHTEST = 65504.0
"""Largest irradiance that a network sees which no tone curve bounds: that of half precision, in which Meng et
al. hold their frames."""


def ten_channels(
    buffers: Mapping[str, Tensor], exposure: Tensor, curve: Callable[[Tensor], Tensor] | None
) -> Tensor:
    """Return what the network sees, (B, 10, H, W).

    Args:
        buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, `albedo` (B, 3, H, W) that it was
            divided by, `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units; optionally
            `depth_range` (B, 2) of the whole frame, otherwise that of this image counts.
        exposure: (B, 1, 1, 1) or (1, 1, 1, 1).
        curve: Tone curve, of exposed radiance to [0, 1]. None: exposed irradiance stands in its place,
            without albedo, in [0, BRIGHTEST].
    """
    light = exposure * buffers["irradiance"]
    color = wide(light).clamp(0.0, BRIGHTEST) if curve is None else curve(light * buffers["albedo"])
    normal = buffers["normal"] * 0.5 + 0.5
    depth = scaled_depth(buffers["depth"], buffers.get("depth_range"))
    return torch.cat([color, buffers["albedo"], normal, depth], 1)


def scaled_depth(depth: Tensor, bounds: Tensor | None) -> Tensor:
    """Return depth (B, 1, H, W) between 0, the nearest, and 1, the farthest; 0 where all are as far.

    Args:
        depth: In scene units.
        bounds: (B, 2), smallest and largest depth of the whole frame; None: those of this image.
    """
    bounds = depth_bounds(depth) if bounds is None else bounds.to(depth.dtype)
    near, far = bounds[:, 0, None, None, None], bounds[:, 1, None, None, None]
    span = far - near
    return torch.where(span > 0, (depth - near) / torch.where(span > 0, span, 1.0), 0.0)


def depth_bounds(depth: Tensor) -> Tensor:
    """Return the smallest and the largest depth (B, 2) of frames (B, 1, H, W)."""
    depth = depth.detach()
    return torch.stack([depth.amin((1, 2, 3)), depth.amax((1, 2, 3))], 1)
