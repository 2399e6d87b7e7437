"""Builders of small data sets in each published layout, cut from the sample that ships."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data.camera import Camera
from data.exr import write_exr
from data.frame import Frame
from data.frames import FrameSet
from data.ingestion import IngestOptions, ingest
from data.sample import SAMPLES

BMFR_FILES = {
    "color": "irradiance",
    "albedo": "albedo",
    "shading_normal": "normal",
    "world_position": "position",
    "reference": "reference",
}


@dataclass(frozen=True)
class Crop:
    """A window of the sample's frames."""

    x: int = 130
    y: int = 70
    width: int = 48
    height: int = 32


def sample_crop(scene: str, index: int, crop: Crop = Crop()) -> Frame:
    """Return a window of a sample frame, with the camera of that window."""
    frame = FrameSet(SAMPLES["bmfr"]).read(scene, index)
    rows, columns = slice(crop.y, crop.y + crop.height), slice(crop.x, crop.x + crop.width)
    assert frame.camera is not None
    matrix = frame.camera.world_to_pixel.copy()
    matrix[0] -= crop.x * matrix[3]
    matrix[1] -= crop.y * matrix[3]
    return replace(
        frame,
        buffers={n: np.ascontiguousarray(b[rows, columns]) for n, b in frame.buffers.items()},
        camera=Camera(matrix, frame.camera.origin),
    )


def bmfr_matrix(camera: Camera, width: int, height: int) -> np.ndarray:
    """Return the row-vector clip-space matrix of a camera."""
    x, y, z, w = camera.world_to_pixel
    return np.stack([2 * x / width - w, 2 * y / height - w, z, w], axis=1)


def camera_header(
    matrices: Sequence[np.ndarray],
    limits: tuple[float, float] | None = (0.01, 1.0),
    offsets: Sequence[tuple[float, float]] | None = None,
) -> str:
    """Return the text of `camera_matrices.h` as the data set has it."""
    count = len(matrices)
    lines = []
    if limits is not None:
        lines += [f"const float position_limit_squared = {limits[0]:.6f};"]
        lines += [f"const float normal_limit_squared = {limits[1]:.6f};"]
    lines += [f"const float camera_matrices[{count}][4][4] = {{"]
    for i, matrix in enumerate(matrices):
        rows = [f"      {{{', '.join(f'{v:.9f}' for v in row)}}}," for row in matrix]
        lines += [f"   {{ // frame {i}", *rows, "   },"]
    lines += ["};"]
    if offsets is not None:
        lines += [f"const float pixel_offsets[{count}][2] = {{"]
        lines += [f"   {{{x:.6f}, {y:.6f}}}, // frame {i}" for i, (x, y) in enumerate(offsets)]
        lines += ["};"]
    return "\n".join(lines) + "\n"


def write_rgb(path: Path, image: np.ndarray) -> None:
    """Write three channels R, G, B in float32."""
    write_exr(path, {c: image[..., i].astype(np.float32) for i, c in enumerate("RGB")})


def bmfr_scene(
    root: Path,
    scene: str,
    frames: int = 2,
    name: str | None = None,
    crop: Crop = Crop(),
) -> Path:
    """Write one scene in the layout of the BMFR data set and return its folder."""
    folder = root / (name or scene)
    matrices = []
    for index in range(frames):
        frame = sample_crop(scene, index, crop)
        for role, buffer in BMFR_FILES.items():
            write_rgb(folder / "inputs" / f"{role}{index}.exr", frame.buffers[buffer])
        assert frame.camera is not None
        matrices.append(bmfr_matrix(frame.camera, crop.width, crop.height))
    header = camera_header(matrices, offsets=[(0.5, 0.5)] * frames)
    (folder / "inputs" / "camera_matrices.h").write_text(header)
    return folder


def penumbra_scene(
    root: Path,
    scene: str,
    frames: int = 2,
    kind: str = "video",
    name: str | None = None,
    crop: Crop = Crop(),
) -> Path:
    """Write one scene in the layout of Penumbra's renders and return its folder."""
    folder = root / (name or scene)
    entries = []
    for index in range(frames):
        frame = sample_crop(scene, index, crop)
        _penumbra_frame(folder, frame, kind)
        assert frame.camera is not None
        to_world = np.eye(4)
        to_world[:3, 3] = frame.camera.centre()
        camera = {"to_world": to_world.tolist(), "world_to_pixel": frame.camera.world_to_pixel.tolist()}
        spp = {"color": 1} if kind == "video" else {"A": 16, "B": 16, "low": 4}
        entries.append(
            {
                "index": index,
                "camera": camera,
                "inputs": {"spp": spp},
                "reference": {"spp": 256, "exposure": frame.exposure},
            }
        )
    sidecar = {"renderer": "mitsuba", "scene": name or scene, "set": kind, "frames": entries}
    (folder / "sequence.json").write_text(json.dumps(sidecar))
    return folder


def _penumbra_frame(folder: Path, frame: Frame, kind: str) -> None:
    b = frame.buffers
    layers = {"albedo": b["albedo"], "specular": np.zeros_like(b["albedo"]), "normal": b["normal"]}
    if kind == "video":
        layers |= {"color": b["color"], "motion": np.zeros((*b["color"].shape[:2], 2), np.float32)}
    else:
        layers |= {"colorA": b["color"], "colorB": b["color"] * np.float32(0.5), "colorVariance": b["color"]}
        layers |= {"diffuse": b["color"] * np.float32(0.25)}
    layers["roughness"] = np.ones_like(b["depth"])
    channels = {}
    for name, image in layers.items():
        letters = {1: "Z", 2: "XY", 3: "XYZ" if name == "normal" else "RGB"}[image.shape[2]]
        channels |= {f"{name}.{c}": image[..., i].astype(np.float16) for i, c in enumerate(letters)}
    channels |= {f"position.{c}": b["position"][..., i] for i, c in enumerate("XYZ")}
    channels["depth.Z"] = b["depth"][..., 0]
    write_exr(folder / f"f{frame.index:03d}_input.exr", channels)
    reference = {f"reference.{c}": b["reference"][..., i].astype(np.float16) for i, c in enumerate("RGB")}
    write_exr(folder / f"f{frame.index:03d}_reference.exr", reference)


def ingested(root: Path, scenes: Sequence[str] = ("classroom", "cbox-glossy"), frames: int = 2) -> Path:
    """Write an ingested data set and return its folder; the last scene in alphabetical order is the test."""
    for scene in scenes:
        penumbra_scene(root / "source", scene, frames)
    ingest("penumbra", root / "source", root / "set", IngestOptions())
    return root / "set"
