"""Layout of Mitsuba's AOV films: EXR files with R, G, B and the AOVs under names that their user chose.

The letters tell the kind: `<name>.T` is depth, `.X .Y .Z` a normal or position, `.R .G .B` albedo or the
picture of a nested integrator, `.U .V` and `.I` coordinates and indices that are not read. Common names, and
for normals the length, tell the rest. References and samples per pixel are found by name (see `twins`), and
`m2_<name>` of the moment integrator becomes a variance where the number of samples is known.

What differs from this project's buffers and is said in the notes: normals are not turned towards the camera;
depth is the ray parameter, counted from the near plane. Where positions are there and a JSON file of the
image's name beside it has `to_world` (4x4, the camera's) or `world_to_pixel`, depth is derived instead. The
albedo of surfaces without a diffuse lobe exceeds 1 and is clipped. Where nothing was hit all AOVs are 0.

Source: Mitsuba 3 documentation, integrators `aov` and `moment`; channel names as written by version 3.9.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data.camera import Camera
from data.exr_image import ExrImage, exr_channels, read_exr
from data.frame import Frame
from data.layouts.channels import Gathering, missing_buffer
from data.layouts.mitsuba_names import MOMENT, Roles, roles_of
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.twins import Job, SceneFiles, scenes_of
from data.layouts.walk import a_few_below

_UNIT_SHARE = 0.75


def likeness(root: Path) -> float:
    """Return the fraction of a few EXR files below a root that look like an AOV film."""
    opened = a_few_below(root, ".exr")
    return sum(_score(p) for p in opened) / len(opened) if opened else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, sorted by name.

    Raises:
        OSError: The root does not exist.
        ValueError: No EXR file, a file that is damaged or lacks albedo or normal, or names that collide.
    """
    root = Path(root)
    require_folder(root)
    files = scenes_of(root)
    if not files:
        raise ValueError(
            f"{root}: no scene of the layout `mitsuba` found, expected EXR files with R, G, B and AOVs such "
            "as albedo.R, nn.X, dd.T, and <name>_ref.exr or reference/<name>.exr"
        )
    return [_scene(root, name, found) for name, found in files.items()]


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(scene: str, jobs: dict[int, Job], index: int) -> Frame:
    """Read one frame, and its reference.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged, has another size, or lacks a picture, albedo or normal.
    """
    job = jobs[index]
    image = read_exr(job.path)
    roles = roles_of(image.channels)
    gathering = Gathering(f"{scene}/frame {index}")
    _picture(gathering, "color", image, roles)
    _features(gathering, image, roles)
    if job.spp is not None and job.spp > 1:
        _variances(gathering, image, roles, job.spp)
    if job.reference is not None:
        other = read_exr(job.reference)
        _picture(gathering, "reference", other, roles_of(other.channels))
    camera = _depth(gathering, image, roles, job.path)
    told = {"view": job.view, "reference_spp": job.reference_spp, "ignored": roles.ignored or None}
    return replace(gathering.frame(scene, index, job.spp, told), camera=camera)


def _score(path: Path) -> float:
    try:
        channels = exr_channels(path)
    except (OSError, ValueError):
        return 0.0
    letters = {channel.rpartition(".")[2] for channel in channels if "." in channel}
    plain = {"R", "G", "B"} <= set(channels) or "Y" in channels
    if not plain or any(".Combined." in f".{channel}" for channel in channels):
        return 0.0
    if "T" in letters or any(channel.startswith(MOMENT) for channel in channels):
        return 1.0
    roles = roles_of(channels)
    return 0.5 if "X" in letters and ("normal" in roles.buffers or roles.unknown) else 0.0


def _scene(root: Path, name: str, files: SceneFiles) -> Scene:
    path = next(iter(files.jobs.values())).path
    channels = exr_channels(path)
    roles = roles_of(channels)
    if "color" not in roles.buffers and not roles.nested:
        raise missing_buffer("mitsuba", path, "color (R, G, B)", channels, root)
    if "diffuse_albedo" not in roles.buffers:
        raise missing_buffer("mitsuba", path, "albedo (such as albedo.R of the AOV albedo)", channels, root)
    if "normal" not in roles.buffers and not roles.unknown:
        raise missing_buffer("mitsuba", path, "normal (such as nn.X of the AOV sh_normal)", channels, root)
    return Scene(
        name,
        tuple(files.jobs),
        partial(read, name, files.jobs),
        depth="euclidean",
        sequence=False,
        provenance="Mitsuba, AOV film",
    )


def _picture(gathering: Gathering, name: str, image: ExrImage, roles: Roles) -> None:
    """Take R, G, B, or the nested picture where those are missing or black."""
    options = [c for c in (roles.buffers.get("color"), *roles.nested.values()) if c is not None]
    if not options:
        found = ", ".join(list(image.channels)[:12])
        raise ValueError(f"{image.path}: missing {name} (R, G, B); found {found}")
    lit = [c for c in options if any(image.channels[channel].any() for channel in c)]
    if not lit:
        raise ValueError(
            f"{image.path}: {', '.join(options[0])} are all 0; nest a path integrator in the aov integrator"
        )
    gathering.add(name, image, lit[0])
    if len(set(lit[0])) == 1:
        gathering.note("assumed", name, "one channel of luminance for red, green and blue")


def _features(gathering: Gathering, image: ExrImage, roles: Roles) -> None:
    for name in ("diffuse_albedo", "position"):
        if name in roles.buffers:
            gathering.add(name, image, roles.buffers[name])
    normal = roles.buffers.get("normal") or _unit(image, roles)
    if normal is None or "diffuse_albedo" not in gathering.buffers:
        missing = "normal" if normal is None else "albedo"
        raise ValueError(f"{image.path}: missing {missing}; found {', '.join(list(image.channels)[:24])}")
    gathering.add("normal", image, normal)
    gathering.note("assumed", "normal", "world space, not turned towards the camera, without bump maps")
    np.clip(gathering.buffers["normal"], -1, 1, out=gathering.buffers["normal"])
    albedo = gathering.buffers["diffuse_albedo"]
    above = int((albedo > 1).any(-1).sum())
    if above:
        gathering.buffers["diffuse_albedo"] = np.minimum(albedo, np.float32(1))
        before = gathering.notes.get("clipped", {}).get("diffuse_albedo", 0)
        gathering.note("clipped", "diffuse_albedo", before + above)


def _unit(image: ExrImage, roles: Roles) -> list[str] | None:
    """Return the first of the unknown vectors that has unit length nearly everywhere."""
    for channels in roles.unknown.values():
        length = np.sqrt(sum(image.channels[c] ** 2 for c in channels))
        hit = length[length > 0]
        if hit.size and float((np.abs(hit - 1) < 0.02).mean()) >= _UNIT_SHARE:
            return channels
    return None


def _variances(gathering: Gathering, image: ExrImage, roles: Roles, spp: int) -> None:
    """Add variances of the mean from second moments: (m2 - mean²) / (spp - 1)."""
    known = {_layer(channels[0]): (name, channels) for name, channels in roles.buffers.items()}
    color = gathering.buffers["color"]
    for layer, channels in roles.nested.items():
        if np.array_equal(np.stack([image.channels[c] for c in channels], -1), color):
            known[layer] = ("color", channels)
    for layer, moments in roles.moments.items():
        if layer in known:
            _variance(gathering, image, *known[layer], moments, spp)
    for layer, moments in roles.moments.items():
        # Only CIE XYZ is known of a picture nested directly in the moment integrator; Y is its luminance.
        if layer not in known and "Y" in moments and f"{layer}.Y" in image.channels:
            _variance(gathering, image, "color", [f"{layer}.Y"] * 3, moments, spp)


def _variance(
    gathering: Gathering, image: ExrImage, name: str, channels: list[str], moments: dict[str, str], spp: int
) -> None:
    target, letters = f"{name}_variance", [c.rpartition(".")[2].upper() for c in channels]
    if target in gathering.buffers or not set(letters) <= moments.keys():
        return
    pairs = zip(letters, channels, strict=True)
    raw = np.stack([image.channels[moments[m]] - image.channels[c] ** 2 for m, c in pairs], -1)
    array = np.maximum(raw, 0).astype(np.float32) / np.float32(spp - 1)
    gathering.put(target, array, str(image.path))
    what = ", of the luminance, for every channel" if len(set(letters)) < len(letters) else ""
    gathering.note("derived", target, f"(m2 - mean^2) / (spp - 1){what}")


def _layer(channel: str) -> str:
    return channel.rpartition(".")[0]


def _depth(gathering: Gathering, image: ExrImage, roles: Roles, path: Path) -> Camera | None:
    """Add depth: from positions where the camera is known, otherwise as written. Returns the camera."""
    camera, origin = _camera(path.with_suffix(".json"))
    position = gathering.buffers.get("position")
    if position is not None and origin is not None:
        known = (position != 0).any(-1, keepdims=True) | (gathering.buffers["normal"] != 0).any(
            -1, keepdims=True
        )
        distance = np.linalg.norm(position - origin.astype(np.float32), axis=-1, keepdims=True)
        gathering.put("depth", np.where(known, distance, 0).astype(np.float32), str(path))
        gathering.note("derived", "depth", "distance of position from the camera")
    elif "depth" in roles.buffers:
        gathering.add("depth", image, roles.buffers["depth"])
        gathering.note("assumed", "depth", "ray parameter from the near plane, shorter than the distance")
    return camera


def _camera(path: Path) -> tuple[Camera | None, Any]:
    """Return the camera and its centre from a JSON file, None where there is no such file or entry."""
    if not path.is_file():
        return None, None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("expected an object with to_world or world_to_pixel")
        camera = Camera.from_json(values) if "world_to_pixel" in values else None
        if "to_world" in values:
            matrix = np.asarray(values["to_world"], np.float64)
            if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
                raise ValueError(f"to_world has shape {matrix.shape}, expected finite 4x4")
            camera = None if camera is None else replace(camera, origin=matrix[:3, 3])
            return camera, matrix[:3, 3]
        return camera, None if camera is None else camera.centre()
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: no camera: {error}") from error
