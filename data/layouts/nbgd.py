"""Layout of NBGD's data: folders as BMFR's, the depth as a picture, and 64 spp Tungsten sequences.

`<scene>/inputs/{albedo,shading_normal,reference}N.exr` as in BMFR, N = 0, 1, 2 …; the noisy light without
albedo is `<scene>/radiance_accum/accum_color_noabdN.exr` (half precision, accumulated over the preceding
frames) or, at 64 spp, `inputs/colorN.exr`, which is of one frame; `<scene>/depth_normalized/N.png` (8 bits)
is the depth scaled to the frame's range. `inputs/world_positionN.exr` and `camera_matrices.h` may be there
as in BMFR; then depth follows from them and the picture is not read.

Accumulated light counts first where both are there, since the layout's own loader reads that; as in BMFR, its
exposure is 1.

Source: Meng et al. 2020, doi:10.2312/sr.20201133.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from data.camera import Camera
from data.exr_image import read_exr
from data.frame import Frame, Image
from data.layouts.bmfr_camera import read_cameras
from data.layouts.channels import Gathering, missing_buffer
from data.layouts.scene import Scene, all_frames, require_folder, subfolders
from data.layouts.siblings import only_group

PLACES = {
    "irradiance": ("radiance_accum", "accum_color_noabd", ".exr"),
    "color": ("inputs", "color", ".exr"),
    "albedo": ("inputs", "albedo", ".exr"),
    "normal": ("inputs", "shading_normal", ".exr"),
    "position": ("inputs", "world_position", ".exr"),
    "reference": ("inputs", "reference", ".exr"),
    "depth": ("depth_normalized", "", ".png"),
}
"""What a file is → folder, beginning and ending of its name; the frame's number is between them."""

SPP = 64

Files = dict[tuple[str, int], Path]


def likeness(root: Path) -> float:
    """Return the fraction of subfolders with this layout's own folders, or without cameras and positions."""
    if not root.is_dir():
        return 0.0
    folders = _folders(root)
    return sum(_looks_like(f) for f in folders) / len(folders) if folders else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, or the root itself where it is one scene, sorted by name.

    Raises:
        OSError: The root or a camera header does not exist.
        ValueError: No scene, gaps in the numbering, or a buffer is missing and cannot be derived.
    """
    root = Path(root)
    require_folder(root)
    scenes = [_scene(root, folder) for folder in _folders(root) if _files(folder)]
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `nbgd` found, expected <scene>/inputs/albedo0.exr, "
            "shading_normal0.exr, reference0.exr, <scene>/depth_normalized/0.png, and "
            "<scene>/radiance_accum/accum_color_noabd0.exr or <scene>/inputs/color0.exr"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(folder: Path, scene: str, index: int) -> Frame:
    """Read one frame.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    files = _files(folder)
    gathering = Gathering(f"{scene}/frame {index}")
    accumulated = ("irradiance", index) in files
    for name, role in _sources(accumulated, _exact_depth(folder, files)).items():
        path = files.get((role, index))
        if path is None:
            continue
        if role == "depth":
            size = next(iter(gathering.buffers.values())).shape[:2]
            gathering.put("depth", _picture(path, size), str(path))
            gathering.note("channels", "depth", [path.name])
        else:
            image = read_exr(path)
            gathering.add(name, image, only_group(image))
    notes = {"normalised": ["depth"]} if "depth" in gathering.buffers else {}
    frame = gathering.frame(scene, index, None if accumulated else SPP, notes)
    frame.exposure = 1.0 if accumulated else None
    return replace(frame, camera=_camera(folder, index, frame), accumulated=accumulated)


def _sources(accumulated: bool, exact_depth: bool) -> dict[str, str]:
    """Return buffer → what its file is."""
    sources = {"irradiance": "irradiance" if accumulated else "color"}
    sources |= {name: name for name in ("albedo", "normal", "reference")}
    return sources | ({"position": "position"} if exact_depth else {"depth": "depth"})


def _folders(root: Path) -> list[Path]:
    if _files(root):
        return [root]
    return subfolders(root)


def _looks_like(folder: Path) -> bool:
    roles = {role for role, _ in _files(folder)}
    if {"irradiance", "depth"} & roles:
        return True
    return {"color", "albedo", "normal"} <= roles and "position" not in roles and _header(folder) is None


def _files(folder: Path) -> Files:
    changed = [_changed(folder / place) for place in ("", "inputs", "radiance_accum", "depth_normalized")]
    return _listed(folder, tuple(changed))


def _changed(folder: Path) -> int:
    return folder.stat().st_mtime_ns if folder.is_dir() else 0


@lru_cache(maxsize=64)
def _listed(folder: Path, changed: tuple[int, ...]) -> Files:
    found: Files = {}
    for role, (place, start, end) in PLACES.items():
        pattern = re.compile(rf"{start}(\d+){re.escape(end)}")
        if (folder / place).is_dir():
            matches = ((pattern.fullmatch(p.name), p) for p in (folder / place).iterdir())
            found |= {(role, int(m[1])): p for m, p in matches if m}
    return found


def _scene(root: Path, folder: Path) -> Scene:
    files = _files(folder)
    name = folder.resolve().name
    indices = sorted({index for _, index in files})
    gaps = sorted(set(range(indices[0], indices[-1] + 1)) - set(indices))
    if gaps:
        raise ValueError(f"{folder}: frame {gaps[0]} is missing between {indices[0]} and {indices[-1]}")
    accumulated = any(("irradiance", index) in files for index in indices)
    exact = _exact_depth(folder, files)
    sources = _sources(accumulated, exact)
    if not any(("reference", index) in files for index in indices):
        del sources["reference"]
    for buffer, role in sources.items():
        for index in indices:
            if (role, index) not in files:
                place, start, end = PLACES[role]
                others = [f"{p.parent.name}/{p.name}" for (_, i), p in sorted(files.items()) if i == index]
                told = f"buffer {buffer!r} ({place}/{start}{index}{end}{_instead(role)})"
                raise missing_buffer("nbgd", folder, told, others, root)
    return Scene(
        name,
        tuple(indices),
        partial(read, folder, name),
        depth="z",
        credit="Meng et al., NBGD data set",
        provenance="NBGD data set (doi:10.2312/sr.20201133), "
        + ("accumulated light" if accumulated else f"Tungsten, {SPP} spp")
        + ("" if exact else "; depth scaled to [0, 1] in each frame, 8 bits"),
    )


def _instead(role: str) -> str:
    if role == "depth":
        return ", or inputs/world_position and camera_matrices.h"
    return ", or radiance_accum/accum_color_noabd" if role == "color" else ""


def _exact_depth(folder: Path, files: Files) -> bool:
    """Return whether depth follows from positions and cameras."""
    return any(role == "position" for role, _ in files) and _header(folder) is not None


def _header(folder: Path) -> Path | None:
    candidates = (folder / "inputs" / "camera_matrices.h", folder / "camera_matrices.h")
    return next((path for path in candidates if path.is_file()), None)


def _camera(folder: Path, index: int, frame: Frame) -> Camera | None:
    header = _header(folder)
    if header is None:
        return None
    cameras = read_cameras(header)
    try:
        return cameras.camera(index, frame.width, frame.height)
    except ValueError as error:
        raise ValueError(f"{header}: {error}") from error


def _picture(path: Path, size: tuple[int, ...]) -> Image:
    """Return a grey picture (H, W, 1) in [0, 1]; its size is compared before it is decoded."""
    from PIL import Image as Pictures
    from PIL import UnidentifiedImageError

    try:
        with Pictures.open(path, formats=("PNG",)) as picture:
            if (picture.height, picture.width) != size:
                raise ValueError(
                    f"{path} is {picture.width}x{picture.height}, but the frame is {size[1]}x{size[0]}"
                )
            deep = picture.mode.startswith("I")
            grey = np.asarray(picture if deep else picture.convert("L"), np.float32)
    except (UnidentifiedImageError, SyntaxError, OSError, Pictures.DecompressionBombError) as error:
        raise ValueError(f"{path}: damaged PNG file ({error}); copy it again") from error
    return grey[..., None] / np.float32(65535 if deep else 255)
