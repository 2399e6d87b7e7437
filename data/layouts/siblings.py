"""Frames whose buffers lie in one EXR file each, beside each other, and what is absent from them.

Tungsten writes its output buffers that way, and so do the data sets of ACFM and AFGSA that were made with it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data.derive import derive
from data.exr_image import ExrImage, read_exr
from data.frame import Frame
from data.layouts.channels import DEFAULT, Gathering, channel_groups, missing_buffer

OTHERS: dict[str, tuple[frozenset[str], ...]] = {
    "color": (frozenset({"diffuse", "specular"}),),
    "diffuse": (frozenset({"color", "specular"}),),
    "specular": (frozenset({"color", "diffuse"}),),
}
"""What buffers of one frame are derived from, besides their halves; see `data.derive`."""


@dataclass(frozen=True)
class View:
    """The files of one frame.

    Attributes:
        name: What its files are called, for messages.
        number: Number of the view; frames of one view with different samples per pixel share it.
        noisy: Buffer → file.
        reference: Buffer → file, `color` or `diffuse` and `specular`; empty without a reference.
        spp: Samples per pixel of the noisy buffers, None where unknown.
        reference_spp: Samples per pixel of the reference, None where unknown.
        ignored: Files that nothing is taken from.
    """

    name: str
    number: int
    noisy: dict[str, Path]
    reference: dict[str, Path]
    spp: int | None = None
    reference_spp: int | None = None
    ignored: tuple[str, ...] = field(default=())


def absent(needed: Iterable[str], present: Collection[str]) -> list[str]:
    """Return those of the needed buffers that are neither present nor derivable from what is."""

    def there(name: str) -> bool:
        return name in present or {f"{name}_a", f"{name}_b"} <= set(present)

    return [n for n in needed if not there(n) and not any(all(map(there, o)) for o in OTHERS.get(n, ()))]


def require_files(
    layout: str, view: View, needed: Iterable[str], root: Path, names: Mapping[str, str]
) -> None:
    """Raise an error unless a view has, or allows to derive, the needed buffers.

    Args:
        layout: Name of the layout.
        view: The files.
        needed: Buffers.
        root: Folder of the source.
        names: Buffer → how its file is called, where the name differs.

    Raises:
        ValueError: Names the file, its buffer and what would do instead.
    """
    found = [path.name for path in (*view.noisy.values(), *view.reference.values())]
    where = next(iter(view.noisy.values())).parent
    for name in absent(needed, view.noisy):
        told = f"buffer {name!r} ({names.get(name, name)}.exr of {view.name}{_instead(name)})"
        raise missing_buffer(layout, where, told, found, root)
    if view.reference and absent(["color"], view.reference):
        told = f"buffer 'reference' (color.exr of {view.name} at {view.reference_spp} spp{_instead('color')})"
        raise missing_buffer(layout, where, told, found, root)


def read_siblings(view: View, needed: Iterable[str], scene: str, index: int) -> Frame:
    """Read the files of a view and derive the needed buffers that have no file.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged, has other channels or another size; the message names it.
    """
    gathering = gathered(view.noisy, f"{scene}/frame {index}")
    notes = {"view": view.number, "reference_spp": view.reference_spp, "ignored": list(view.ignored) or None}
    frame = derive(gathering.frame(scene, index, view.spp, notes), needed)
    if view.reference:
        frame = with_reference(frame, gathered(view.reference, f"{scene}/frame {index} (reference)"))
    return frame


def gathered(files: Mapping[str, Path], label: str) -> Gathering:
    """Read one buffer from each file."""
    gathering = Gathering(label)
    for name, path in files.items():
        image = read_exr(path)
        gathering.add(name, image, only_group(image))
    return gathering


def with_reference(frame: Frame, reference: Gathering) -> Frame:
    """Return the frame with `color` and `diffuse` of another gathering as its reference, derived if need be.

    Raises:
        ValueError: The reference has another size.
    """
    roles = {"color": "reference"}
    if {"diffuse", "specular"} & reference.buffers.keys():
        roles["diffuse"] = "reference_diffuse"
    converged = derive(reference.frame(frame.scene, frame.index, None), roles)
    if (converged.height, converged.width) != (frame.height, frame.width):
        raise ValueError(
            f"{frame.label}: the reference is {converged.width}x{converged.height}, the noisy buffers are "
            f"{frame.width}x{frame.height}; both must be of one size"
        )
    result = frame.with_buffers(**{role: converged.buffers[name] for name, role in roles.items()})
    for key in ("repaired", "precision", "channels", "clipped", "derived"):
        told: dict[str, Any] = converged.notes.get(key, {})
        renamed = {role: told[name] for name, role in roles.items() if name in told}
        if key == "repaired" and told and not renamed:
            renamed = {"reference": sum(told.values())}
        if renamed:
            result.notes[key] = {**result.notes.get(key, {}), **renamed}
    return result


def reference_parts(found: Mapping[str, Any]) -> list[str]:
    """Return which of color, diffuse and specular to read as the reference: no more than is needed."""
    needed = (
        ("color", "diffuse") if {"color", "diffuse"} <= found.keys() else ("color", "diffuse", "specular")
    )
    return [name for name in needed if name in found]


def only_group(image: ExrImage) -> list[str]:
    """Return the channels of a file that holds one buffer.

    Raises:
        ValueError: It has several groups of channels and none without a name.
    """
    groups = channel_groups(image.channels)
    if DEFAULT in groups:
        return groups[DEFAULT]
    if len(groups) > 1:
        raise ValueError(
            f"{image.path}: expected one buffer (channels R, G, B or Z), found {', '.join(image.channels)}"
        )
    return next(iter(groups.values()))


def _instead(name: str) -> str:
    ways = [" and ".join(sorted(way)) for way in OTHERS.get(name, ())]
    return f", or {' or '.join(ways)}" if ways else ""
