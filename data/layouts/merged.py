"""Merged EXR files: all buffers of a frame as groups of channels in one file, the reference in another.

Channels are `R`, `G`, `B` (the group `default`) or `color.R` …, `diffuse.R`, `specular.R`, `albedo.R`,
`normal.R`, `.G`, `.B` (not X, Y, Z), `depth.Z`, `visibility.Z`; variances `colorVariance.Z` … in one
channel or three; halves `colorA.R`, `colorB.R` …. A reference is told by its name, `<view>_gt.exr` or
`gt.exr` (also ref, reference, target), or by the highest number of samples among `<view>-00128spp.exr` and
`<view>-08192spp.exr`. Files directly in the root are one scene each, files in a subfolder are the views of
one scene.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from data.buffers import BUFFERS
from data.derive import derive
from data.exr_image import exr_channels, read_exr
from data.frame import Frame
from data.layouts.channels import DEFAULT, REFERENCE_WORDS, Gathering, channel_groups, missing_buffer
from data.layouts.scene import Scene, subfolders
from data.layouts.siblings import absent, reference_parts, with_reference

GROUPS = {
    "color": "color",
    "diffuse": "diffuse",
    "specular": "specular",
    "albedo": "diffuse_albedo",
    "normal": "normal",
    "depth": "depth",
    "visibility": "visibility",
    "position": "position",
}

_SPP = re.compile(r"(?P<view>.*?)[-_.]?(?P<spp>\d+)spp")
_BARE = re.compile(r"(?P<view>.+)_(?P<spp>\d+)")
_REFERENCE = re.compile(rf"(?:(?P<view>.+)[-_.])?(?:{'|'.join(REFERENCE_WORDS)})")
_GROUP = re.compile(rf"(?P<group>{'|'.join(GROUPS)})(?P<part>A|B|Variance)?")
_PARTS = {"A": "_a", "B": "_b", "Variance": "_variance", None: ""}


@dataclass(frozen=True)
class MergedView:
    """One frame: a merged file, and its reference where it has one."""

    scene: str
    name: str
    number: int
    noisy: Path
    reference: Path | None
    spp: int | None
    reference_spp: int | None


def buffers_of(channels: Iterable[str]) -> dict[str, list[str]]:
    """Return buffer → channels for the groups that have a meaning here; `default` counts before `color`."""
    found: dict[str, list[str]] = {}
    groups = channel_groups(channels)
    for group in sorted(groups, key=lambda g: g != DEFAULT):
        match = _GROUP.fullmatch("color" if group == DEFAULT else group)
        if match:
            name = GROUPS[match["group"]] + _PARTS[match["part"]]
            if name in BUFFERS:
                found.setdefault(name, groups[group])
    return found


def views(root: Path) -> list[MergedView]:
    """Return the frames below a root, by the names of the files alone."""
    return [v for f in _folders(root) for v in _folder_views(f, f == root, f.stat().st_mtime_ns)]


def share(found: list[MergedView], needed: set[str], without: set[str]) -> float:
    """Return the fraction of the first files that have all the needed groups and none of the others."""
    sample = found[:4]
    good = 0
    for view in sample:
        try:
            groups = channel_groups(exr_channels(view.noisy)).keys()
        except (OSError, ValueError):
            continue
        good += needed <= groups and not (without & groups)
    return good / len(sample) if sample else 0.0


def scenes(layout: str, root: Path, needed: tuple[str, ...], credit: str, provenance: str) -> list[Scene]:
    """Return the scenes of merged files, checked for the needed buffers.

    Raises:
        ValueError: A buffer is missing and cannot be derived, or some frames of a scene lack a reference.
        OSError: A file cannot be opened.
    """
    for folder in _folders(root):
        _check_references(layout, root, folder)
    grouped: dict[str, list[MergedView]] = {}
    for view in views(root):
        grouped.setdefault(view.scene, []).append(view)
    result = []
    for name, members in grouped.items():
        for view in members:
            _check(layout, root, view, needed)
        lone = next((v for v in members if v.reference is None), None)
        if lone is not None and any(v.reference for v in members):
            files = [v.reference.name for v in members if v.reference is not None]
            told = f"buffer 'reference' (no reference beside {lone.noisy.name})"
            raise missing_buffer(layout, lone.noisy.parent, told, files, root)
        levels = [
            sorted({v.spp for v in members if v.spp}),
            sorted({v.reference_spp or 0 for v in members} - {0}),
        ]
        spp = [", ".join(map(str, some)) or "unknown" for some in levels]
        result.append(
            Scene(
                name,
                tuple(range(len(members))),
                partial(read, root, needed, name),
                depth="euclidean",
                sequence=False,
                credit=credit,
                provenance=f"{provenance}, {spp[0]} spp, reference {spp[1]} spp",
            )
        )
    return result


def read(root: Path, needed: tuple[str, ...], scene: str, index: int) -> Frame:
    """Read one frame.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged, or the reference has another size; the message names it.
    """
    view = [v for v in views(root) if v.scene == scene][index]
    gathering, ignored = _gathered(view.noisy, f"{scene}/frame {index}")
    notes = {"view": view.number, "reference_spp": view.reference_spp, "ignored": ignored or None}
    frame = derive(gathering.frame(scene, index, view.spp, notes), needed)
    if view.reference is not None:
        frame = with_reference(frame, _converged(view.reference, f"{scene}/frame {index} (reference)"))
    return frame


def _folders(root: Path) -> list[Path]:
    if not root.is_dir():
        return []
    return [root, *subfolders(root)]


def _check_references(layout: str, root: Path, folder: Path) -> None:
    """Refuse a reference that belongs to no frame."""
    files = _files(folder)
    marked = _marked(files)
    noisy = {_view_of(p.stem, marked)[0] for p in files if p not in marked.values()}
    for name, path in marked.items():
        if noisy and name not in noisy and (name or len(noisy) > 1):
            told = f"buffer 'color' (the noisy file that {path.name} is the reference of)"
            raise missing_buffer(layout, folder, told, [p.name for p in files], root)


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*.exr") if p.is_file() and not p.name.startswith("."))


def _marked(files: Iterable[Path]) -> dict[str, Path]:
    """Return view → reference for the files whose names mark them; an empty view is the only one."""
    return {m["view"] or "": p for p in files if (m := _REFERENCE.fullmatch(p.stem))}


def _gathered(path: Path, label: str) -> tuple[Gathering, list[str]]:
    image = read_exr(path)
    gathering = Gathering(label)
    found = buffers_of(image.channels)
    for name, channels in found.items():
        gathering.add(name, image, channels)
    used = {channel for channels in found.values() for channel in channels}
    return gathering, sorted(set(image.channels) - used)


def _converged(path: Path, label: str) -> Gathering:
    image = read_exr(path)
    found = buffers_of(image.channels)
    gathering = Gathering(label)
    for name in reference_parts(found):
        gathering.add(name, image, found[name])
    return gathering


def _check(layout: str, root: Path, view: MergedView, needed: tuple[str, ...]) -> None:
    channels = exr_channels(view.noisy)
    for name in absent(needed, buffers_of(channels)):
        group = next((g for g, b in GROUPS.items() if b == name), name)
        raise missing_buffer(layout, view.noisy, f"buffer {name!r} (channels {group}.*)", channels, root)
    if view.reference is not None:
        channels = exr_channels(view.reference)
        if absent(["color"], buffers_of(channels)):
            told = "buffer 'reference' (channels R, G, B, or color.*, or diffuse.* and specular.*)"
            raise missing_buffer(layout, view.reference, told, channels, root)


@lru_cache(maxsize=256)
def _folder_views(folder: Path, top: bool, changed: int) -> tuple[MergedView, ...]:
    files = _files(folder)
    marked = _marked(files)
    noisy: dict[str, list[tuple[int | None, Path]]] = {}
    for path in files:
        if path in marked.values():
            continue
        name, spp = _view_of(path.stem, marked)
        noisy.setdefault(name, []).append((spp, path))
    found = []
    for number, (name, unsorted) in enumerate(sorted(noisy.items())):
        levels = sorted(unsorted, key=lambda level: (level[0] or 0, level[1]))
        reference, most = marked.get(name, marked.get("") if len(noisy) == 1 else None), None
        if reference is None and len(levels) > 1 and levels[-1][0] is not None:
            most, reference = levels.pop()
        scene = (name or folder.resolve().name) if top else folder.resolve().name
        found += [
            MergedView(scene, name, 0 if top else number, path, reference, spp, most) for spp, path in levels
        ]
    return tuple(found)


def _view_of(stem: str, marked: dict[str, Path]) -> tuple[str, int | None]:
    match = _SPP.fullmatch(stem)
    if match is None and stem not in marked:
        bare = _BARE.fullmatch(stem)
        match = bare if bare is not None and bare["view"] in marked else None
    return (stem, None) if match is None else (match["view"], int(match["spp"]))
