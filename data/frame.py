"""A frame: the buffers of one view at one time, its camera and where it came from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import buffer, sample_channels
from data.camera import Camera

Image = NDArray[np.float32]


@dataclass
class Samples:
    """The samples of a frame, kept apart.

    Attributes:
        values: float32 (S, H, W, C), S samples per pixel in no particular order, raw linear values; NaN in
            every channel of a sample that does not count (`data.dropped`).
        channels: What the C channels are, such as `radiance.R`; see `data.buffers.SAMPLE_BUFFERS`.
    """

    values: NDArray[np.float32]
    channels: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check channels, type and shape.

        Raises:
            ValueError: Says what was expected and what came.
        """
        sample_channels(*self.names)
        if self.channels != sample_channels(*self.names):
            raise ValueError(f"samples have the channels {self.channels}, some are missing or out of order")
        shape = self.values.shape
        if self.values.ndim != 4 or shape[3] != len(self.channels) or min(shape) == 0:
            raise ValueError(f"samples have shape {shape}, expected (S, H, W, {len(self.channels)})")
        if self.values.dtype != np.float32:
            raise ValueError(f"samples are {self.values.dtype}, expected float32")

    @property
    def names(self) -> tuple[str, ...]:
        """Quantities in order: radiance, normal …"""
        return tuple(dict.fromkeys(channel.partition(".")[0] for channel in self.channels))

    @property
    def count(self) -> int:
        """Samples per pixel."""
        return self.values.shape[0]

    def get(self, name: str) -> NDArray[np.float32]:
        """Return one quantity, a view (S, H, W, c).

        Raises:
            ValueError: The samples do not have it.
        """
        if name not in self.names:
            raise ValueError(f"the samples have no {name!r}; they have {', '.join(self.names)}")
        wanted = sample_channels(name)
        first = self.channels.index(wanted[0])
        return self.values[..., first : first + len(wanted)]

    @staticmethod
    def of(parts: dict[str, NDArray[np.float32]]) -> Samples:
        """Return samples made of quantities, each (S, H, W, c)."""
        return Samples(np.concatenate(list(parts.values()), -1), sample_channels(*parts))


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
        samples: The samples of each pixel, where the source keeps them apart.
        thin_lens: Aperture radius, focus distance and field of view (`data.buffers.FRAME_NUMBERS`), None
            where unknown.
    """

    buffers: dict[str, Image]
    scene: str
    index: int
    camera: Camera | None = None
    exposure: float | None = None
    spp: int | None = None
    accumulated: bool = False
    notes: dict[str, Any] = field(default_factory=dict)
    samples: Samples | None = None
    thin_lens: tuple[float, float, float] | None = None

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

    def follows(self, last: Frame | None) -> bool:
        """Return whether it is the frame after `last` of the same scene.

        Frames with `notes["view"]` show one view with several numbers of samples: the next view with the same
        number comes after one.
        """
        if last is None or last.scene != self.scene:
            return False
        now, before = self.notes.get("view"), last.notes.get("view")
        if now is None or before is None:
            return last.index + 1 == self.index
        return bool(before + 1 == now) and last.spp == self.spp

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
        numbers = self.thin_lens
        if numbers is not None and not all(math.isfinite(n) and n >= 0 for n in numbers):
            raise ValueError(f"{self.label}: thin_lens is {numbers}, expected numbers >= 0")
        size = (self.height, self.width)
        if self.samples is not None and self.samples.values.shape[1:3] != size:
            height, width = self.samples.values.shape[1:3]
            raise ValueError(
                f"{self.label}: samples are {width}x{height}, the buffers {self.width}x{self.height}"
            )

    def require(self, *names: str, hint: str = "") -> None:
        """Raise a ValueError that names the missing buffers, unless all are there; a hint ends it."""
        missing = [name for name in names if name not in self.buffers]
        if missing:
            raise ValueError(
                f"{self.label}: missing buffer {', '.join(missing)}; it has {', '.join(self.buffers)}"
                f"{hint and f'; {hint}'}"
            )

    def with_buffers(self, **changes: Image) -> Frame:
        """Return a copy in which these buffers are added or replaced."""
        return replace(self, buffers={**self.buffers, **changes}, notes=dict(self.notes))
