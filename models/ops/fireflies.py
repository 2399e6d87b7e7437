"""Fireflies: single pixels that one sample out of many made far too bright.

A path that is improbable and bright leaves a pixel of which one half of the samples knows, while the other
half and the neighbours know nothing of it. `limited_halves` brings such a pixel down: it is at most
`LIMIT` times the largest value among the 3x3 pixels around it in the other half,

    a'_p = a_p * min(1, LIMIT * max over q in 3x3 of b_q / a_p)

and the same with the halves exchanged. The ratio is taken between the largest channels, so that colour does
not change. The neighbourhood holds the pixel itself: what both halves show stays, whatever its size, and so
does a highlight of several pixels of which the other half has some. The variance of the mean shrinks with the
square of what the mean does, as that of a scaled sample. The halves stay independent but for the limit.

Light is lost: fireflies carry a part of the image's energy, only badly distributed. Measured on 96x96 parts
of stills of 32 samples per pixel, sum of the limited by that of the given image, and relative squared error
(e = 0.01) of NFOR without and with:

    living-room      0.999   0.143   0.123        outdoor-000005   0.978   0.069   0.021
    sponza           0.999   0.0079  0.0078       outdoor-000003   0.971   0.480   0.120
    indoor-000002    0.998   0.242   0.186        classroom        0.957   0.050   0.040
    cbox-glossy      0.976   0.0110  0.0083       veach-lamp       0.756   2.24    0.123

(veach-lamp at this number of samples is fireflies for the most part). With LIMIT = 1 errors are about as low,
but ordinary noise is cut off as well: 0.973 is left of sponza, 0.902 of classroom.

It takes two halves: where one buffer stands for both, each pixel lies in its own neighbourhood and stays.

Related: RDFC (doi:10.1111/cgf.12219) and LBF (doi:10.1145/2766977) replace outliers by medians of 3x3 pixels.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch.nn.functional as F
from torch import Tensor

from models.ops.halves import Halves, Noise, independent

Fireflies = Literal["keep", "limit"]
"""What methods do with them."""


KEPT = "; its fireflies stay, since they are known by what the other half does not show"
"""Added to the reason where one buffer comes to stand for both halves of a colour whose fireflies were to be
limited."""

LIMIT = 2.0
"""How far a pixel may exceed the largest value around it in the other half."""

_TINY = 1e-30


def limited_halves(halves: Halves) -> Halves:
    """Limit the fireflies of each half by the other half.

    Args:
        halves: Radiance, (..., C, H, W), at least 0.
    """
    a, b, variance = halves
    limited_a, limited_b = a * _share(a, b), b * _share(b, a)
    share = (limited_a + limited_b).clamp_min(_TINY) / (a + b).clamp_min(_TINY)
    return Halves(limited_a, limited_b, variance * share.square())


def checked(method: str, fireflies: Fireflies, noise: Noise) -> Fireflies:
    """Refuse an unknown word, and to limit fireflies of a colour without two halves.

    Raises:
        ValueError: Names the method, the option and what it may be.
    """
    if fireflies not in get_args(Fireflies):
        raise ValueError(f"{method}: fireflies must be keep or limit, got {fireflies!r}")
    if fireflies == "limit" and not independent(noise):
        raise ValueError(
            f"{method}: fireflies=limit compares two halves of the colour, and color_noise={noise} has none; "
            "use fireflies=keep"
        )
    return fireflies


def _share(image: Tensor, other: Tensor) -> Tensor:
    """Return how much of each pixel stays, (..., 1, H, W) in [0, 1]."""
    own, limit = image.amax(-3, keepdim=True), other.amax(-3, keepdim=True)
    flat = limit.reshape(-1, 1, *limit.shape[-2:])
    around = F.max_pool2d(flat, 3, 1, 1).reshape(limit.shape)
    return (LIMIT * around / own.clamp_min(_TINY)).clamp(0.0, 1.0)
