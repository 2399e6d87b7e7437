"""A frame: the buffers of one view at one time, its camera and where it came from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import buffer
from data.camera import Camera

Image = NDArray[np.float32]


@dataclass
class Frame:
    """Buffers of one view at one time.

    Attributes:
        buffers: Name of the vocabulary → float32 array (H, W, C), row 0 at the top, raw linear values.
        scene: Name of the scene; data sets are split by it.
        index: Number of the frame within its sequence.
        camera: Camera of this frame, None where unknown.
        exposure: Factor that brings radiance to a displayable level, None where unknown.
        spp: Samples per pixel of the noisy buffers, None where unknown.
        accumulated: `irradiance` is accumulated over the preceding frames.
        notes: What was derived, repaired or assumed, for the manifest and `trainer inspect`.
    """

    buffers: dict[str, Image]
    scene: str
    index: int
    camera: Camera | None = None
    exposure: float | None = None
    spp: int | None = None
    accumulated: bool = False
    notes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.validate()

    @property
    def height(self) -> int:
        """Number of rows."""
        return next(iter(self.buffers.values())).shape[0]

    @property
    def width(self) -> int:
        """Number of columns."""
        return next(iter(self.buffers.values())).shape[1]

    @property
    def label(self) -> str:
        """`scene/frame index`, for messages."""
        return f"{self.scene}/frame {self.index}"

    def validate(self) -> None:
        """Check names, types and sizes.

        Raises:
            ValueError: Names the frame, the buffer, what was expected and what came.
        """
        if not self.buffers:
            raise ValueError(f"{self.label} has no buffers")
        sizes = {name: array.shape[:2] for name, array in self.buffers.items()}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items())
            raise ValueError(f"{self.label}: buffers of different size: {listed}")
        for name, array in self.buffers.items():
            expected = buffer(name).channels
            if array.ndim != 3 or array.shape[2] != expected:
                raise ValueError(
                    f"{self.label}: buffer {name!r} has shape {array.shape}, expected (H, W, {expected})"
                )
            if array.dtype != np.float32:
                raise ValueError(f"{self.label}: buffer {name!r} is {array.dtype}, expected float32")

    def require(self, *names: str) -> None:
        """Raise a ValueError that names the missing buffers, unless all are there."""
        missing = [name for name in names if name not in self.buffers]
        if missing:
            raise ValueError(
                f"{self.label}: missing buffer {', '.join(missing)}; it has {', '.join(self.buffers)}"
            )

    def with_buffers(self, **changes: Image) -> Frame:
        """Return a copy in which these buffers are added or replaced."""
        return replace(self, buffers={**self.buffers, **changes}, notes=dict(self.notes))
