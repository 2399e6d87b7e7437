"""Exposure and tone curves that networks see; they are part of a module, never of the data."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from models.ops.boxes import exporting
from models.ops.precision import wide

GAMMA = 0.454545
"""Exponent of the WSKP code, which is not exactly 1 / 2.2."""

LARGEST = 1e12
"""Bound of exposed radiance, before log and after exp: far above any firefly, and products of it, such as
squares, stay far below overflow."""

_SRGB_LINEAR = 0.0031308
"""Up to this the sRGB curve is a line."""

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
    bounded = wide(radiance).clamp(0.0, 1.0)
    dark = bounded < _DARKEST
    curve = bounded.clamp_min(_DARKEST).pow(GAMMA)
    return torch.where(dark, bounded * (_DARKEST ** (GAMMA - 1.0)), curve)


def filmic(radiance: Tensor) -> Tensor:
    """Return t (6.2 t + 0.5) / (t (6.2 t + 1.7) + 0.06), t = max(0, x - 0.004), in float32 or wider.

    A film's curve that includes the display's gamma of about 2.2.

    Args:
        radiance: Exposed linear radiance of any shape, up to `LARGEST`.

    Returns:
        Values in [0, 1).

    Source: J. Hable, after J. Hejl and R. Burgess-Dawson; as in the code of Meng et al. 2020
    (doi:10.2312/sr.20201133) for 64 samples per pixel.
    """
    value = (wide(radiance) - 0.004).clamp_min(0.0)
    return value * (6.2 * value + 0.5) / (value * (6.2 * value + 1.7) + 0.06)


def srgb_log(radiance: Tensor, darkest: float = 1e-5) -> Tensor:
    """Return sRGB(log(1 + x)) of radiance x clipped to [darkest, 65536], in float32 or wider, up to 2.7.

    Args:
        radiance: Exposed linear radiance of any shape.
        darkest: Lower bound; the gradient is 0 below it.

    Source: equations 7 and 8 of Munkberg and Hasselgren 2020 (doi:10.1111/cgf.14049); the bounds are those
    of the authors' code.
    """
    value = torch.log1p(wide(radiance).clamp(darkest, 65536.0))
    curve = 1.055 * value.clamp_min(_SRGB_LINEAR).pow(1 / 2.4) - 0.055
    return torch.where(value > _SRGB_LINEAR, curve, 12.92 * value)


def exposed(radiance: Tensor, exposure: Tensor) -> Tensor:
    """Return radiance times exposure in [0, LARGEST], float32 or wider; what is no number counts as 0.

    Args:
        radiance: Linear radiance (B, C, H, W); or its variance, with the square of the exposure.
        exposure: (B, 1, 1, 1) or (1, 1, 1, 1).
    """
    return torch.nan_to_num(wide(radiance) * wide(exposure), 0.0).clamp(0.0, LARGEST)


def radiance_of(log: Tensor) -> Tensor:
    """Return exp(log) - 1, the inverse of log(1 + radiance), in [0, LARGEST] and precise near 0.

    ONNX has no operator for exp(x) - 1. Recorded graphs hold (exp(x) + 1) tanh(x / 2), which is the same and
    as precise.

    Args:
        log: float32 or wider; negative values count as 0.
    """
    bounded = log.clamp(0.0, math.log1p(LARGEST))
    if not exporting():
        return torch.expm1(bounded)
    return (torch.exp(bounded) + 1.0) * torch.tanh(0.5 * bounded)
