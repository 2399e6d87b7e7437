"""Layout of Penumbra's first renders: `<scene>/f000_{input,samples,reference,low}.exr` with `sequence.json`.

`video` sets have one noisy colour per frame and a moving camera; `stills` have two halves, variances and
independent views; `layers` keep their samples apart, in `samples` instead of `input`. In these files `albedo`
and `specular` are the diffuse and specular reflectance of the first hit, `depth` is the distance from the
camera's centre, and the sidecar holds cameras and exposures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data.camera import Camera
from data.exr import read_frame
from data.frame import Frame
from data.layouts.scene import Scene, all_frames, require_folder, subfolders

_SIDECAR = "sequence.json"
_INPUT = re.compile(r"f(\d+)_(?:input|samples)\.exr$")


def likeness(root: Path) -> float:
    """Return the fraction of subfolders with a sidecar and input frames."""
    if not root.is_dir():
        return 0.0
    folders = _folders(root)
    return sum(_is_scene(f) for f in folders) / len(folders) if folders else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, or the root itself where it is one scene, sorted by name.

    Raises:
        OSError: The root does not exist.
        ValueError: No scene is found, a sidecar is damaged, or files and sidecar disagree.
    """
    root = Path(root)
    require_folder(root)
    scenes = [_scene(folder) for folder in _folders(root) if _is_scene(folder)]
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `penumbra` found, expected folders with {_SIDECAR} and "
            "f000_input.exr, f001_input.exr …"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def _folders(root: Path) -> list[Path]:
    if (root / _SIDECAR).is_file():
        return [root]
    return subfolders(root)


def _is_scene(folder: Path) -> bool:
    return (folder / _SIDECAR).is_file() and any(_INPUT.search(p.name) for p in folder.iterdir())


def _sidecar(folder: Path) -> dict[str, Any]:
    path = folder / _SIDECAR
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
            raise ValueError("no list of frames")
        return values
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _scene(folder: Path) -> Scene:
    sidecar = _sidecar(folder)
    found = sorted(int(m.group(1)) for p in folder.iterdir() if (m := _INPUT.search(p.name)))
    listed = [int(f["index"]) for f in sidecar["frames"]]
    missing = sorted(set(listed) - set(found))
    if missing:
        raise ValueError(
            f"{folder}: {_SIDECAR} lists frame {missing[0]}, but f{missing[0]:03d}_input.exr is missing"
        )
    unlisted = sorted(set(found) - set(listed))
    if unlisted:
        raise ValueError(f"{folder / _SIDECAR}: frame {unlisted[0]} is not described, but its file exists")
    name = str(sidecar.get("scene") or folder.name)
    counts = sorted({s for f in sidecar["frames"] if (s := (f.get("reference") or {}).get("spp"))})
    spp = " to ".join(str(s) for s in dict.fromkeys((counts[0], counts[-1]))) if counts else "unknown"
    renderer = f"{sidecar.get('renderer', 'unknown renderer')} {sidecar.get('renderer_version', '')}".strip()
    return Scene(
        name,
        tuple(found),
        partial(read, folder),
        depth="euclidean",
        sequence=sidecar.get("set") == "video",
        provenance=f"{renderer}, reference {spp} spp",
    )


def read(folder: Path, index: int) -> Frame:
    """Read one frame: input, and the reference where there is one.

    Raises:
        ValueError: Files of different size, a damaged file, or a frame that the sidecar does not describe.
    """
    sidecar = _sidecar(folder)
    entry = next((f for f in sidecar["frames"] if int(f["index"]) == index), None)
    if entry is None:
        raise ValueError(f"{folder / _SIDECAR}: frame {index} is not described")
    apart = folder / f"f{index:03d}_samples.exr"
    frame = read_frame(apart if apart.is_file() else folder / f"f{index:03d}_input.exr")
    _reflectances(frame)
    reference = folder / f"f{index:03d}_reference.exr"
    if reference.is_file():
        other = read_frame(reference)
        for name in ("reference", "reference_diffuse"):
            if name not in other.buffers:
                continue
            frame.buffers[name] = other.buffers[name]
            for key in ("repaired", "precision", "channels"):
                if name in other.notes.get(key, {}):
                    frame.notes.setdefault(key, {})[name] = other.notes[key][name]
    spp = (entry.get("reference") or {}).get("spp")
    if spp is not None and "reference" in frame.buffers:
        frame.notes["reference_spp"] = int(spp)
    return replace(
        frame,
        scene=str(sidecar.get("scene") or folder.name),
        index=index,
        camera=_camera(folder, entry),
        exposure=_exposure(folder, entry),
        spp=_spp(entry) or (None if frame.samples is None else frame.samples.count),
        thin_lens=_thin_lens(folder, entry),
    )


def _reflectances(frame: Frame) -> None:
    """Name `albedo` and `specular` of this layout, whatever else the file holds."""
    for old, new in (("albedo", "diffuse_albedo"), ("specular", "specular_albedo")):
        if old in frame.buffers:
            frame.buffers[new] = frame.buffers.pop(old)
            for key in ("repaired", "precision", "channels"):
                if old in frame.notes.get(key, {}):
                    frame.notes[key][new] = frame.notes[key].pop(old)


def _camera(folder: Path, entry: dict[str, Any]) -> Camera | None:
    values = entry.get("camera")
    if not values:
        return None
    try:
        camera = Camera.from_json(values)
    except ValueError as error:
        raise ValueError(f"{folder / _SIDECAR}, frame {entry['index']}: {error}") from error
    to_world = values.get("to_world")
    origin = None if to_world is None else np.asarray(to_world, np.float64)[:3, 3]
    return replace(camera, origin=origin)


def _thin_lens(folder: Path, entry: dict[str, Any]) -> tuple[float, float, float] | None:
    values = entry.get("camera") or {}
    if "fov_x_degrees" not in values:
        return None
    aperture = values.get("aperture_radius") or 0.0
    focus = (values.get("focus_distance") or 0.0) if aperture else 0.0
    try:
        return float(aperture), float(focus), float(values["fov_x_degrees"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder / _SIDECAR}, frame {entry['index']}: camera: {error}") from error


def _exposure(folder: Path, entry: dict[str, Any]) -> float | None:
    exposure = (entry.get("reference") or {}).get("exposure")
    if exposure is None:
        return None
    if not float(exposure) > 0:
        raise ValueError(f"{folder / _SIDECAR}, frame {entry['index']}: exposure {exposure}, expected > 0")
    return float(exposure)


def _spp(entry: dict[str, Any]) -> int | None:
    spp = (entry.get("inputs") or {}).get("spp") or {}
    if "color" in spp:
        return int(spp["color"])
    return int(spp["A"]) + int(spp["B"]) if {"A", "B"} <= spp.keys() else None
