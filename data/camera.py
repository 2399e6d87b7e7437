"""Cameras: world points to pixels, positions to depth, motion between frames.

Pixels are measured from the top left corner of the image, x to the right, y down, centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        world_to_pixel: 4x4, column vectors: `p = M @ [x, y, z, 1]`, pixel `p[:2] / p[3]`; `p[3]` is the
            z depth, positive in front of the camera.
        origin: Centre of the camera in world space (3,), None where the source does not say.
    """

    world_to_pixel: NDArray[np.float64]
    origin: NDArray[np.float64] | None = None
