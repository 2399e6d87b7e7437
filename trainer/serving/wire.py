"""Frames as bytes between processes: a line of JSON, then the arrays. No pickle, and sizes are checked."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.camera import Camera
from data.frame import Frame, Samples

MAX_LINE = 1 << 22
"""Bytes of the longest line: notes of a frame are the largest part of it."""


@dataclass(frozen=True)
class Parcel:
    """What is sent: plain values, and arrays after them."""

    values: dict[str, Any]
    arrays: tuple[NDArray[np.float32], ...] = ()

    def line(self) -> bytes:
        """Return the first line, which says which arrays follow."""
        shapes = [list(array.shape) for array in self.arrays]
        return json.dumps({"values": self.values, "shapes": shapes}).encode() + b"\n"


def pack(frame: Frame, notes: Iterable[str]) -> Parcel:
    """Return a frame as it is sent.

    Args:
        frame: The frame.
        notes: Remarks of the reader.
    """
    values = {
        "buffers": list(frame.buffers),
        "scene": frame.scene,
        "index": frame.index,
        "camera": frame.camera.to_json() if frame.camera else None,
        "exposure": frame.exposure,
        "spp": frame.spp,
        "accumulated": frame.accumulated,
        "notes": frame.notes,
        "thin_lens": frame.thin_lens,
        "samples": frame.samples.channels if frame.samples else None,
        "remarks": list(notes),
    }
    kept = [] if frame.samples is None else [frame.samples.values]
    return Parcel(values, tuple(np.ascontiguousarray(a) for a in [*frame.buffers.values(), *kept]))


def unpack(parcel: Parcel) -> tuple[Frame, list[str]]:
    """Return the frame and the remarks.

    Raises:
        ValueError: It is no frame.
    """
    values, arrays = parcel.values, list(parcel.arrays)
    samples = Samples(arrays.pop(), tuple(values["samples"])) if values["samples"] else None
    frame = Frame(
        dict(zip(values["buffers"], arrays, strict=True)),
        scene=values["scene"],
        index=values["index"],
        camera=Camera.from_json(values["camera"]) if values["camera"] else None,
        exposure=values["exposure"],
        spp=values["spp"],
        accumulated=values["accumulated"],
        notes=values["notes"],
        samples=samples,
        thin_lens=tuple(values["thin_lens"]) if values["thin_lens"] else None,
    )
    return frame, values["remarks"]


def receive(read_line: Callable[[], bytes], read_into: Callable[[memoryview], None], largest: int) -> Parcel:
    """Return what the other side sent.

    Args:
        read_line: Returns the next line.
        read_into: Fills a piece of memory with the bytes that follow.
        largest: Bytes of all arrays, at most.

    Raises:
        ValueError: It is not what `Parcel.line` writes, or too large.
    """
    content = json.loads(read_line())
    shapes = [tuple(int(side) for side in shape) for shape in content["shapes"]]
    size = sum(4 * int(np.prod(shape, dtype=object)) for shape in shapes)
    if size > largest or any(side < 0 for shape in shapes for side in shape):
        raise ValueError(f"{size} bytes of arrays, at most {largest} are taken")
    arrays = tuple(np.empty(shape, np.float32) for shape in shapes)
    for array in arrays:
        read_into(array.data.cast("B"))
    return Parcel(content["values"], arrays)
