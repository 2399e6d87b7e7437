"""What filters share that carry their history from frame to frame of a sequence.

The state of a frame is a mapping of tensors (B, …) that the next call takes; without one, or with that of a
frame of another size, a sequence starts anew. History is looked up anywhere in the frame before, so that
frames are never cut into tiles.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from torch import Tensor

from models.denoiser import Buffers, Denoiser, State
from models.ops.antialiasing import antialiased
from models.ops.guides import finite
from models.ops.reproject import Neighbours
from models.ops.tonemap import LARGEST


class SequenceFilter(Denoiser):
    """Base class of filters with `forward(buffers, state)`, whose states are detached tensors (B, …)."""

    recurrent = True
    whole = True
    frame_numbers = ("exposure",)
    no_export = "each of its frames needs the state of the one before, which exported files do not hand over"

    def made_by(self, missing: Collection[str]) -> str:
        """Say which commands make what is missing."""
        hint = f"{type(self).__name__} works on sequences: `trainer render sequences` writes all it reads"
        derived = [name for name in missing if name in ("motion", "depth")]
        if derived:
            names = " and ".join(derived)
            hint += f"; `trainer denoise` derives {names} for frames with position and cameras"
        return hint

    def _exposed(self, buffers: Buffers) -> tuple[Tensor, Tensor]:
        """Return exposed irradiance, at least 0 and finite, and the exposure (B or 1, 1, 1, 1).

        What is no number counts as 0, as in the released code of both methods.
        """
        light = finite(buffers["irradiance"])
        exposure = self.exposure({**buffers, self.inputs[0]: light})
        return (light * exposure).clamp(0.0, LARGEST), exposure

    def _finished(
        self,
        light: Tensor,
        buffers: Buffers,
        exposure: Tensor,
        before: tuple[Mapping[str, Tensor], Neighbours] | None,
        new: float | None,
        white: float | None = None,
    ) -> Tensor:
        """Return radiance (B, 3, H, W) from filtered exposed irradiance: with albedo, antialiased.

        Args:
            light: Exposed irradiance.
            buffers: With `albedo`.
            exposure: Of this frame.
            before: The state before, with `output`, and where pixels were; None: there is none.
            new: Weight of this frame in antialiasing; None: no antialiasing.
            white: Exposed radiance that is cut before antialiasing; None: none is.
        """
        image = (light * finite(buffers["albedo"], 1.0).clamp_min(0.0)).clamp_max(white or LARGEST)
        if before is not None and new is not None:
            state, neighbours = before
            image = antialiased(image, state["output"] * exposure, neighbours, new)
        return image / exposure


def follows(state: Mapping[str, Tensor] | None, like: Tensor) -> bool:
    """Return whether there is a state, of a frame as large as this and as many of them.

    Args:
        state: Of the frame before.
        like: A buffer of this frame (B, C, H, W).
    """
    if state is None:
        return False
    images = [plane for plane in state.values() if plane.ndim == 4]
    return all(plane.shape[0] == like.shape[0] and plane.shape[2:] == like.shape[2:] for plane in images)


def carried(**planes: Tensor) -> State:
    """Return a state of these tensors, through which no gradient flows."""
    return {name: plane.detach() for name, plane in planes.items()}


def checked(
    method: str, given: Mapping[str, Any], *, positive: Collection[str], shares: Collection[str]
) -> None:
    """Refuse numbers outside their range.

    Args:
        method: Whose options they are.
        given: The options; None passes.
        positive: Names of those that must be above 0.
        shares: Names of those that must be above 0 and at most 1.

    Raises:
        ValueError: Names the method, the option and its range.
    """
    for name in (*positive, *shares):
        value = given[name]
        if value is not None and not value > 0:
            most = " and at most 1" if name in shares else ""
            raise ValueError(f"{method}: {name} must be above 0{most}, got {value}")
        if name in shares and value > 1:
            raise ValueError(f"{method}: {name} must be above 0 and at most 1, got {value}")
