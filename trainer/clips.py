"""What `trainer denoise` was given, as clips: frames in order, read one at a time, results named.

A path may be an EXR file, a folder of EXR files, an ingested data set (`manifest.json`), a folder of a
published layout (`sequence.json`, BMFR) or `sample:NAME`, a data set that ships with Penumbra.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from data.camera import DepthKind
from data.exr import read_frame
from data.frame import Frame
from data.frames import FrameSet
from data.layouts import layout, likeliest
from data.root import SAMPLE, resolve_root

BESIDE = "tungsten"
"""The layout whose frames are several files in one folder: `color.exr`, `colorA.exr`, `normal.exr` …"""


@dataclass(frozen=True)
class Item:
    """One frame of a clip.

    Attributes:
        read: Reads it.
        label: File or scene and number, for messages.
        name: Path of its result below the output folder, without suffix.
        source: The file it is read from, where it is a single one.
    """

    read: Callable[[], Frame]
    label: str
    name: str
    source: Path | None = None


@dataclass(frozen=True)
class Clip:
    """Frames that may follow one another.

    Attributes:
        items: The frames, in order.
        sequence: Consecutive frames of one camera path; False: independent views.
        depth: What depth means.
        thresholds: Limits for accumulation, where the data set says them.
    """

    items: tuple[Item, ...]
    sequence: bool = True
    depth: DepthKind = "euclidean"
    thresholds: dict[str, float] = field(default_factory=dict)


def find_clips(paths: Iterable[str], split: str | None = None) -> list[Clip]:
    """Return the clips that the given paths mean; nothing but manifests and sidecars is read.

    Args:
        paths: As listed above; single files of one folder make one clip.
        split: Only the scenes of this split, for ingested data sets.

    Raises:
        ValueError: Nothing to denoise in a path, `split` for something without splits, or two frames whose
            results would have the same name.
        FileNotFoundError: A path does not exist.
    """
    clips: list[Clip] = []
    files: dict[Path, list[Path]] = {}
    for given in paths:
        path = resolve_root(given).path if given.startswith(SAMPLE) else Path(given).expanduser()
        if not path.exists():
            raise FileNotFoundError(f"{given}: no such file or folder")
        if path.is_file():
            files.setdefault(path.parent, []).append(path)
        else:
            clips += _folder(path, split)
    if split is not None and files:
        raise ValueError(
            f"--split {split} is for ingested data sets, but {next(iter(files))} holds single files"
        )
    clips += [_files(in_order(set(group)), folder, len(files) > 1) for folder, group in files.items()]
    _refuse_same_names(clips)
    return clips


def _folder(path: Path, split: str | None) -> list[Clip]:
    if (path / "manifest.json").is_file():
        return _data_set(path, split)
    if (path / "index.json").is_file():
        raise ValueError(f"{path} holds shards of patches; denoise the ingested frames they were cut from")
    if split is not None:
        raise ValueError(f"--split {split} needs an ingested data set, and {path} has no manifest.json")
    if any(path.glob("**/sequence.json")) or not any(path.glob("*.exr")):
        kind = likeliest(path)
        if kind is not None:
            return _layout(path, kind)
    if layout(BESIDE).likeness(path) > 0:
        return _layout(path, BESIDE)
    found = in_order(path.glob("*.exr"))
    if not found:
        raise ValueError(
            f"{path} holds nothing to denoise: no .exr files, no manifest.json, no folders of a known layout"
        )
    return [_files(found, path, False)]


def _data_set(root: Path, split: str | None) -> list[Clip]:
    frames = FrameSet(root)
    scenes = frames.scenes(split)
    if not scenes:
        known = ", ".join(name for name, members in frames.manifest.splits.items() if members)
        raise ValueError(f"{root} has no scene in the split {split!r}; splits with scenes: {known}")
    clips = []
    for scene in scenes:
        record = frames.manifest.scenes[scene]
        for strand in record.strands():
            items = tuple(
                Item(
                    partial(frames.read, scene, frame.index),
                    str(root / frame.file),
                    f"{scene}/f{frame.index:03d}",
                    root / frame.file,
                )
                for frame in strand
            )
            clips.append(Clip(items, record.sequence, frames.manifest.depth, dict(record.thresholds)))
    return clips


def _layout(root: Path, kind: str) -> list[Clip]:
    clips = []
    for scene in layout(kind).describe(root):
        items = tuple(
            Item(partial(scene.read, i), f"{root}: {scene.name} frame {i}", f"{scene.name}/f{i:03d}")
            for i in scene.indices
        )
        clips.append(Clip(items, scene.sequence, scene.depth, dict(scene.thresholds)))
    return clips


def _files(found: list[Path], folder: Path, several: bool) -> Clip:
    prefix = f"{folder.resolve().name}/" if several else ""
    sequence, depth, thresholds = _known_about(folder)
    items = tuple(Item(partial(read_frame, p), str(p), f"{prefix}{p.stem}", p) for p in found)
    return Clip(items, sequence, depth, thresholds)


def _known_about(folder: Path) -> tuple[bool, DepthKind, dict[str, float]]:
    """Return what the manifest of the data set around a scene's folder says about it, if there is one.

    Whether its frames are one sequence, what depth means, and the limits for accumulation.
    """
    try:
        manifest = FrameSet(folder.resolve().parent).manifest
    except (OSError, ValueError, json.JSONDecodeError):
        return True, "euclidean", {}
    scene = manifest.scenes.get(folder.resolve().name)
    if scene is None:
        return True, manifest.depth, {}
    return scene.sequence and len(scene.strands()) == 1, manifest.depth, dict(scene.thresholds)


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return files as the frames of a sequence follow each other."""
    return sorted(paths, key=_order)


def _order(path: Path) -> tuple[str, list[tuple[int, str]]]:
    """Sort by folder, then by name with numbers as numbers: f2 before f10."""
    parts = re.split(r"(\d+)", path.stem)
    return str(path.parent), [(int(p), "") if p.isdigit() else (-1, p) for p in parts]


def _refuse_same_names(clips: list[Clip]) -> None:
    seen: dict[str, str] = {}
    for item in (item for clip in clips for item in clip.items):
        if item.name in seen:
            raise ValueError(
                f"{seen[item.name]} and {item.label} would both be written as {item.name}.exr; "
                "denoise them with one --output each"
            )
        seen[item.name] = item.label
