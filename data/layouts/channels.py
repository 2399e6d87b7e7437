"""Frames gathered from the channels of foreign files: grouping, checks, repairs, and what is missing."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data.buffers import buffer
from data.exr import RadianceWarning, looks_encoded
from data.exr_image import ExrImage
from data.frame import Frame, Image
from data.repair import repair

DEFAULT = "default"
"""Group of the channels without a dot."""

REFERENCE_WORDS = ("gt", "ref", "reference", "target")
"""Endings of file names that mark the reference."""

_ORDER = "RGBAXYZ"


def channel_groups(channels: Iterable[str]) -> dict[str, list[str]]:
    """Return group → channels: the part before the first dot, `default` without one.

    Channels are ordered R, G, B, A, X, Y, Z, and others by name after them.
    """
    groups: dict[str, list[str]] = {}
    for channel in channels:
        group, dot, _ = channel.partition(".")
        groups.setdefault(group if dot else DEFAULT, []).append(channel)
    return {group: sorted(members, key=_rank) for group, members in groups.items()}


class MissingBufferError(ValueError):
    """A buffer is absent; the message says already which layout looks closer."""


def missing_buffer(layout: str, place: str | Path, name: str, found: Iterable[str], root: Path) -> ValueError:
    """Return an error for a buffer that is absent and cannot be derived.

    Args:
        layout: The layout that was asked for.
        place: File or folder in which it was looked for.
        name: The buffer, with what would do instead where that helps: `specular (or color and diffuse)`.
        found: Channels or files that are there.
        root: Folder of the source, to see which other layouts it resembles.
    """
    from data.layouts import closer

    return MissingBufferError(
        f"{place}: missing {name}; found {_some(found) or 'nothing'}{closer(root, layout)}"
    )


@dataclass
class Gathering:
    """The buffers of one frame while they are gathered from channels and files.

    Attributes:
        label: `scene/frame index`, for messages.
        buffers: Name of the vocabulary → float32 (H, W, C), repaired.
        notes: As in `Frame.notes`.
    """

    label: str
    buffers: dict[str, Image] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)

    def add(self, name: str, image: ExrImage, channels: Sequence[str]) -> None:
        """Take channels of a file as a buffer.

        A variance in one channel counts for every channel. Values that are not finite are repaired, negative
        ones of buffers that cannot be negative become 0; both are counted in the notes.

        Raises:
            ValueError: Too few channels, or another size than the buffers before.
        """
        wanted = buffer(name).channels
        chosen = list(channels[:wanted])
        if name.endswith("_variance") and len(channels) < wanted:
            chosen = [channels[0]] * wanted
            self.note("derived", name, f"{channels[0]} for every channel")
        if len(chosen) < wanted:
            raise ValueError(
                f"{image.path}: buffer {name!r} needs {wanted} channels, found {', '.join(channels)}"
            )
        array = np.stack([image.channels[c] for c in chosen], -1)
        hidden = image.outside.get(chosen[0])
        if hidden is not None:
            array[hidden] = buffer(name).no_hit
            self.note("outside_data_window", name, int(hidden.sum()))
        self.put(name, array, str(image.path))
        precisions = {image.precision[c] for c in chosen}
        self.note("precision", name, precisions.pop() if len(precisions) == 1 else "mixed")
        self.note("channels", name, [f"{image.path.name}: {', '.join(dict.fromkeys(chosen))}"])

    def put(self, name: str, array: Image, source: str) -> None:
        """Take an array as a buffer, repaired and clipped as in `add`.

        Args:
            name: Name of the vocabulary.
            array: float32 (H, W, C).
            source: Where it comes from, for messages.

        Raises:
            ValueError: Another size than the buffers before, or the buffer is there already.
        """
        if name in self.buffers:
            raise ValueError(f"{source}: a second {name!r} for {self.label}")
        first = next(iter(self.buffers.items()), None)
        if first is not None and first[1].shape[:2] != array.shape[:2]:
            (height, width), (rows, columns) = array.shape[:2], first[1].shape[:2]
            raise ValueError(
                f"{source}: {name!r} is {width}x{height}, but {first[0]!r} of {self.label} is "
                f"{columns}x{rows}"
            )
        repaired, counts = repair({name: array})
        if counts:
            self.note("repaired", name, counts[name])
        self.buffers[name] = self._positive(name, repaired[name])
        reason = looks_encoded(array) if buffer(name).kind == "radiance" else None
        if reason:
            warnings.warn(
                f"{source}: buffer {name!r} {reason}; linear radiance is expected, render to EXR",
                RadianceWarning,
                stacklevel=3,
            )

    def note(self, key: str, name: str, value: Any) -> None:
        """Remember something about a buffer, in `notes[key][name]`."""
        self.notes.setdefault(key, {})[name] = value

    def decode_normal(self) -> None:
        """Decode a normal that was stored as (n + 1) / 2, and say so in `notes["decoded"]`."""
        normal = self.buffers.get("normal")
        if normal is None or not is_encoded_normal(normal):
            return
        for name in ("normal", "normal_a", "normal_b"):
            if name in self.buffers:
                stored = self.buffers[name]
                decoded = np.where(stored.any(-1, keepdims=True), 2 * stored - 1, np.float32(0))
                self.buffers[name] = decoded.astype(np.float32)
                self.note("decoded", name, "2 n - 1, was stored in [0, 1]")
        if "normal_variance" in self.buffers:
            self.buffers["normal_variance"] = 4 * self.buffers["normal_variance"]
            self.note("decoded", "normal_variance", "4 times, since the normal was stored in [0, 1]")

    def frame(self, scene: str, index: int, spp: int | None, notes: dict[str, Any] | None = None) -> Frame:
        """Return the frame; `notes` are added to those gathered, entries that are None left out."""
        self.decode_normal()
        told = {k: v for k, v in (notes or {}).items() if v is not None}
        return Frame(self.buffers, scene, index, spp=spp, notes={**self.notes, **told})

    def _positive(self, name: str, array: Image) -> Image:
        entry = buffer(name)
        if entry.low != 0 or name.endswith(("_a", "_b")):
            return array
        negative = array < 0
        number = int(negative.any(-1).sum())
        if not number:
            return array
        self.note("clipped", name, number)
        return np.where(negative, np.float32(0), array)


def is_encoded_normal(normal: Image) -> bool:
    """Return whether normals (H, W, 3) are stored as (n + 1) / 2 instead of in [-1, 1].

    They are where nothing is negative or above 1 and `2 n - 1` has unit length at most pixels while `n` has
    not. Pixels without a hit, (0, 0, 0) or (0.5, 0.5, 0.5), do not count.
    """
    if normal.min(initial=0) < -1e-3 or normal.max(initial=0) > 1 + 1e-3:
        return False
    counted = normal[(np.abs(normal) > 1e-3).any(-1) & (np.abs(normal - 0.5) > 4e-3).any(-1)]
    if not counted.size:
        return False
    as_stored, decoded = (
        float(np.median(np.abs(np.linalg.norm(n, axis=-1) - 1))) for n in (counted, 2 * counted - 1)
    )
    return decoded < 0.1 and decoded < as_stored


def _rank(channel: str) -> tuple[int, str]:
    letter = channel.rpartition(".")[2].upper()
    return (_ORDER.index(letter) if len(letter) == 1 and letter in _ORDER else len(_ORDER), channel)


def _some(names: Iterable[str], count: int = 16) -> str:
    listed = list(names)
    more = f" and {len(listed) - count} more" if len(listed) > count else ""
    return ", ".join(listed[:count]) + more
