"""Tone curves that networks see; they are part of a module, never of the data."""

from __future__ import annotations

import torch
from torch import Tensor

GAMMA = 0.454545
"""Exponent of the WSKP code, which is not exactly 1 / 2.2."""

_DARKEST = 1e-12
"""Below this the curve continues linearly: the slope of x**0.45 grows without bound at 0."""


def gamma(radiance: Tensor) -> Tensor:
    """Return `clamp(max(x, 0) ** 0.454545, 0, 1)`, the display curve of WSKP, in float32 or wider.

    Args:
        radiance: Exposed linear radiance of any shape; negative values count as 0.

    Returns:
        Values in [0, 1], exactly 0 at 0. The gradient is finite everywhere and 0 outside (0, 1).

    Source: the tone curve of Fan et al. 2021 (doi:10.1111/cgf.14338), as in the authors' code.
    """
    wide = radiance if radiance.dtype == torch.float64 else radiance.float()
    bounded = wide.clamp(0.0, 1.0)
    dark = bounded < _DARKEST
    curve = bounded.clamp_min(_DARKEST).pow(GAMMA)
    return torch.where(dark, bounded * (_DARKEST ** (GAMMA - 1.0)), curve)
