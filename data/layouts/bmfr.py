"""Layout of the BMFR data set, also as WSKP arranges it.

`<scene>/inputs/{albedo,color,shading_normal,world_position,reference}N.exr`, N = 0, 1, 2 … not zero-padded,
each with channels R, G, B. `color` is 1 spp *without* albedo, `reference` is 4096 spp *with* albedo. Cameras
are in `camera_matrices.h` beside the images or in the scene's folder, or in `<scene>.h`, `cameras/<scene>.h`.
The set has no depth: it is the clip-space w of the world position. WSKP's accumulated colours (`acc_colors/`)
are not read, since accumulation is repeated here.

Source: Koskela et al. 2019, doi:10.1145/3269978; thresholds as in the authors' camera headers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path

from data.exr import read_frame
from data.frame import Frame
from data.layouts.bmfr_camera import BmfrCameras, read_cameras
from data.layouts.scene import Scene, all_frames, require_folder, subfolders

ROLES = {
    "color": "irradiance",
    "albedo": "albedo",
    "shading_normal": "normal",
    "world_position": "position",
    "reference": "reference",
}
REQUIRED = ("color", "albedo", "shading_normal", "world_position")

THRESHOLDS = {
    "sponza": (0.0016, 0.25),
    "sponzaglossy": (0.0016, 0.25),
    "sponzamovinglight": (0.0016, 0.25),
    "classroom": (0.01, 1.0),
    "livingroom": (0.0009, 0.04),
    "sanmiguel": (0.0009, 1.0),
}
"""Squared limits of position and normal per scene, for headers without them; names without punctuation, since
folders are called living-room or livingroom, sponza-glossy or sponza-(glossy)."""

_FILE = re.compile(rf"({'|'.join(ROLES)})(\d+)\.exr$")


def likeness(root: Path) -> float:
    """Return the fraction of subfolders that hold files of this layout."""
    if not root.is_dir():
        return 0.0
    folders = _folders(root)
    return sum(bool(_files(_inputs(f))) for f in folders) / len(folders) if folders else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, or the root itself where it is one scene, sorted by name.

    Raises:
        OSError: The root or a camera header does not exist.
        ValueError: No scene, missing files, gaps in the numbering, or fewer cameras than frames.
    """
    root = Path(root)
    require_folder(root)
    scenes = [_scene(root, folder) for folder in _folders(root) if _files(_inputs(folder))]
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `bmfr` found, expected <scene>/inputs/ with "
            f"{', '.join(f'{role}0.exr' for role in ROLES)} and camera_matrices.h"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(inputs: Path, header: Path, scene: str, index: int) -> Frame:
    """Read one frame from its files.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    files = _files(inputs)
    parts = {
        role: read_frame(files[role, index], only=buffer)
        for role, buffer in ROLES.items()
        if (role, index) in files
    }
    first = parts["color"]
    notes: dict[str, dict[str, object]] = {}
    for role, part in parts.items():
        if (part.height, part.width) != (first.height, first.width):
            raise ValueError(
                f"{files[role, index]} is {part.width}x{part.height}, but {files['color', index].name} "
                f"is {first.width}x{first.height}"
            )
        for key in ("repaired", "precision"):
            if part.notes.get(key):
                notes.setdefault(key, {}).update(part.notes[key])
    return Frame(
        {name: image for part in parts.values() for name, image in part.buffers.items()},
        scene=scene,
        index=index,
        camera=_cameras(header).camera(index, first.width, first.height),
        exposure=1.0,
        spp=1,
        notes={**notes, "channels": {ROLES[role]: [files[role, index].name] for role in parts}},
    )


def _cameras(header: Path) -> BmfrCameras:
    status = header.stat()
    return _parsed(header, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=32)
def _parsed(header: Path, changed: int, size: int) -> BmfrCameras:
    return read_cameras(header)


def _folders(root: Path) -> list[Path]:
    if _files(_inputs(root)):
        return [root]
    return subfolders(root)


def _inputs(folder: Path) -> Path:
    return folder / "inputs" if (folder / "inputs").is_dir() else folder


def _files(inputs: Path) -> dict[tuple[str, int], Path]:
    found = ((_FILE.match(p.name), p) for p in inputs.iterdir())
    return {(m.group(1), int(m.group(2))): p for m, p in found if m}


def _scene(root: Path, folder: Path) -> Scene:
    inputs = _inputs(folder)
    resolved = folder.resolve()
    name = resolved.parent.name if resolved.name == "inputs" else resolved.name
    files = _files(inputs)
    indices = sorted({index for _, index in files})
    _check_complete(inputs, files, indices)
    header = _header(root, folder, inputs, name)
    cameras = _cameras(header)
    if len(cameras.matrices) <= indices[-1]:
        raise ValueError(
            f"{header}: {len(cameras.matrices)} matrices, but {inputs} has frames up to {indices[-1]}"
        )
    return Scene(
        name,
        tuple(indices),
        partial(read, inputs, header, name),
        depth="z",
        thresholds=_thresholds(name, cameras),
        credit="Koskela et al., BMFR data set",
        provenance="BMFR data set (doi:10.1145/3269978), 1 spp, reference 4096 spp",
    )


def _check_complete(inputs: Path, files: dict[tuple[str, int], Path], indices: list[int]) -> None:
    gaps = sorted(set(range(indices[0], indices[-1] + 1)) - set(indices))
    if gaps:
        raise ValueError(f"{inputs}: frame {gaps[0]} is missing between {indices[0]} and {indices[-1]}")
    has_reference = any(("reference", i) in files for i in indices)
    roles = (*REQUIRED, "reference") if has_reference else REQUIRED
    missing = [f"{role}{i}.exr" for role in roles for i in indices if (role, i) not in files]
    if missing:
        listed = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        raise ValueError(f"{inputs}: missing {listed}; every frame needs {', '.join(roles)}")


def _header(root: Path, folder: Path, inputs: Path, name: str) -> Path:
    candidates = [
        *(place / "camera_matrices.h" for place in (inputs, folder)),
        *(place / f"{name}.h" for place in (inputs, folder, folder.parent, root, root / "cameras")),
        *(folder.parent / "cameras" / f"{alias}.h" for alias in (name, name.replace("-", ""))),
    ]
    for path in candidates:
        if path.is_file():
            return path
    tried = ", ".join(dict.fromkeys(str(p) for p in candidates))
    raise FileNotFoundError(f"scene {name!r}: no camera header; looked for {tried}")


def _thresholds(name: str, cameras: BmfrCameras) -> dict[str, float]:
    table = THRESHOLDS.get(re.sub(r"[^a-z]", "", name.lower()))
    pairs = zip(
        ("position_limit_squared", "normal_limit_squared"),
        (cameras.position_limit_squared, cameras.normal_limit_squared),
        table or (None, None),
        strict=True,
    )
    found = {key: given if given is not None else known for key, given, known in pairs}
    return {key: value for key, value in found.items() if value is not None}
