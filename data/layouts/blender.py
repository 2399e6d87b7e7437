"""Layout of Blender's multi-layer EXR files with Cycles' Denoising passes: `0001.exr`, `0002.exr` …

Channels are `<view layer>.<pass>.<letter>`, such as `ViewLayer.Noisy Image.R`. Several view layers with a
picture become scenes of their own. `color` is Noisy Image, since Combined may be denoised already; where a
file has no Noisy Image, Combined is as noisy as the rest. References are found by name (see `twins`), samples
per pixel in the header, else by name. Numbered frames without a gap are a sequence.

`diffuse` is (DiffDir + DiffInd) DiffCol + Emit + Env, in older files with the Subsurface passes; `albedo` is
Denoising Albedo, `diffuse_albedo` DiffCol, `specular_albedo` GlossCol + TransCol. Normal is in world space;
Denoising Normal, its substitute, in camera space. Depth is z and 1e10 (65504 or infinity in half precision)
where nothing was hit; Denoising Depth, its substitute, the length of the path. Vector X and Y are the
previous minus this pixel with y up, which is turned.

Source: Blender manual, chapter "Passes"; directions of Vector by Cycles' definition, previous minus current
in raster space, whose rows count from the bottom.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data.camera import DepthKind
from data.derive import effective_albedo
from data.exr_image import HALF_MAX, ExrImage, exr_channels, read_exr
from data.frame import Frame, Image
from data.layouts.channels import Gathering, missing_buffer
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.twins import Job, SceneFiles, scenes_of
from data.layouts.walk import a_few_below

FAR = 1e9
"""Depths from here on are misses in float files; Blender writes 1e10."""

UNSET_MOTION = 1e4
"""Components of Vector from here on mean that there is no motion."""

_ALIASES = {
    "Image": "Combined",
    "Z": "Depth",
    "Diffuse Direct": "DiffDir",
    "Diffuse Indirect": "DiffInd",
    "Diffuse Color": "DiffCol",
    "Glossy Color": "GlossCol",
    "Transmission Color": "TransCol",
    "Emission": "Emit",
    "Environment": "Env",
}
"""Names of passes in other versions of Blender."""

_WANTED = {"albedo": ("Denoising Albedo", "DiffCol"), "normal": ("Normal", "Denoising Normal")}
_REFLECTANCES = ("Denoising Albedo", "DiffCol", "GlossCol", "TransCol")
_UNSAFE = re.compile(r"[^\w.-]+")

_Passes = dict[str, dict[str, str]]


def likeness(root: Path) -> float:
    """Return the fraction of a few EXR files below a root that have passes of Cycles."""
    opened = a_few_below(root, ".exr")
    return sum(_has_passes(p) for p in opened) / len(opened) if opened else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, sorted by name, one per view layer with a picture.

    Raises:
        OSError: The root does not exist.
        ValueError: No EXR file, a file that is damaged or lacks a pass, or images whose names collide.
    """
    root = Path(root)
    require_folder(root)
    files = scenes_of(root)
    if not files:
        raise ValueError(
            f"{root}: no scene of the layout `blender` found, expected multi-layer files such as 0001.exr "
            "with the passes Noisy Image or Combined, Normal, Denoising Albedo, and ref/0001.exr"
        )
    return [scene for name, found in files.items() for scene in _scenes(root, name, found)]


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(scene: str, layer: str, jobs: dict[int, Job], index: int) -> Frame:
    """Read one frame of a view layer, and its reference.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged, has another size, or lacks the view layer or its picture.
    """
    job = jobs[index]
    image = read_exr(job.path)
    passes = _layers(image.channels).get(layer, {})
    if not {"Noisy Image", "Combined"} & passes.keys():
        raise ValueError(f"{job.path}: view layer {layer!r} has no picture, other frames have it")
    gathering = Gathering(f"{scene}/frame {index}")
    if _add(gathering, "color", image, passes, "Noisy Image", "Combined") == "Combined":
        gathering.note("assumed", "color", "Combined, there is no Noisy Image")
    _features(gathering, image, passes)
    diffuse = _diffuse(image, passes)
    if diffuse is not None:
        gathering.put("diffuse", diffuse, str(job.path))
        gathering.note("derived", "diffuse", "(DiffDir + DiffInd) DiffCol + Emit + Env")
    reference_spp = job.reference_spp
    if job.reference is not None:
        reference_spp = _reference(gathering, job.reference, layer) or reference_spp
    spp = _spp(image, layer) or job.spp
    return gathering.frame(scene, index, spp, {"view": job.view, "reference_spp": reference_spp})


def _layers(channels: Any) -> dict[str, _Passes]:
    """Return view layer → pass → letter → channel."""
    layers: dict[str, _Passes] = {}
    for channel in channels:
        rest, _, letter = channel.rpartition(".")
        layer, _, name = rest.rpartition(".")
        if name:
            layers.setdefault(layer, {}).setdefault(_ALIASES.get(name, name), {})[letter.upper()] = channel
    return layers


def _has_passes(path: Path) -> bool:
    try:
        layers = _layers(exr_channels(path))
    except (OSError, ValueError):
        return False
    known = {"Noisy Image", "Denoising Albedo", "Denoising Normal", "DiffCol", "Denoising Depth"}
    return any("Combined" in passes or known & passes.keys() for passes in layers.values())


def _scenes(root: Path, name: str, files: SceneFiles) -> list[Scene]:
    path = next(iter(files.jobs.values())).path
    channels = exr_channels(path)
    layers = {
        layer: passes
        for layer, passes in _layers(channels).items()
        if {"Noisy Image", "Combined"} & passes.keys() and layer != "Composite"
    }
    if not layers:
        raise missing_buffer("blender", path, "color (pass Noisy Image or Combined)", channels, root)
    for layer, passes in layers.items():
        for wanted, options in _WANTED.items():
            if not set(options) & passes.keys():
                what = f"{wanted} (pass {' or '.join(options)} of view layer {layer!r})"
                raise missing_buffer("blender", path, what, channels, root)
    scenes = []
    for layer, passes in sorted(layers.items()):
        own = name if len(layers) == 1 else f"{name}-{_UNSAFE.sub('_', layer)}"
        scenes.append(
            Scene(
                own,
                tuple(files.jobs),
                partial(read, own, layer, files.jobs),
                depth=_depth_kind(passes),
                sequence=files.consecutive,
                provenance=f"Blender, Cycles, view layer {layer!r}",
            )
        )
    return scenes


def _depth_kind(passes: _Passes) -> DepthKind:
    return "euclidean" if "Denoising Depth" in passes and "Depth" not in passes else "z"


def _letters(passes: _Passes, name: str, letters: str) -> list[str] | None:
    found = passes.get(name, {})
    return [found[letter] for letter in letters] if all(letter in found for letter in letters) else None


def _add(gathering: Gathering, name: str, image: ExrImage, passes: _Passes, *options: str) -> str | None:
    """Take the first pass that is there as a buffer, and return its name."""
    letters = "XYZ" if name in ("normal", "position") else "RGB"
    for option in options:
        channels = _letters(passes, option, letters) or _letters(passes, option, "RGB")
        if channels is not None:
            gathering.add(name, image, channels)
            return option
    return None


def _pixels(image: ExrImage, passes: _Passes, name: str) -> Image | None:
    channels = _letters(passes, name, "RGB")
    return None if channels is None else np.stack([image.channels[c] for c in channels], -1)


def _features(gathering: Gathering, image: ExrImage, passes: _Passes) -> None:
    taken = _add(gathering, "normal", image, passes, "Normal", "Denoising Normal")
    if taken == "Denoising Normal":
        gathering.note("assumed", "normal", "Denoising Normal: camera space, of the first rough surface")
    if "normal" in gathering.buffers:
        np.clip(gathering.buffers["normal"], -1, 1, out=gathering.buffers["normal"])
    _add(gathering, "position", image, passes, "Position")
    _add_reflectances(gathering, image, passes)
    _add_depth(gathering, image, passes)
    vector = _letters(passes, "Vector", "XY")
    if vector is not None:
        motion = np.stack([image.channels[vector[0]], -image.channels[vector[1]]], -1)
        motion[~(np.abs(motion) < UNSET_MOTION).all(-1)] = 0
        gathering.put("motion", motion, str(image.path))
        gathering.note("channels", "motion", [f"{image.path.name}: {vector[0]}, -{vector[1]}"])


def _add_reflectances(gathering: Gathering, image: ExrImage, passes: _Passes) -> None:
    parts = {name: _pixels(image, passes, name) for name in _REFLECTANCES}
    specular = [p for p in (parts["GlossCol"], parts["TransCol"]) if p is not None]
    found = {
        "albedo": parts["Denoising Albedo"],
        "diffuse_albedo": parts["DiffCol"],
        "specular_albedo": np.sum(specular, 0, dtype=np.float32) if specular else None,
    }
    for name, raw in found.items():
        if raw is None:
            continue
        finite = np.where(np.isfinite(raw), raw, np.float32(0))
        above = int((finite > 1 + 1e-3).any(-1).sum())
        clipped = np.clip(raw, None, 1).astype(np.float32)
        gathering.put(
            name, effective_albedo(np.nan_to_num(clipped)) if name == "albedo" else clipped, str(image.path)
        )
        if above:
            gathering.note("clipped", name, above + gathering.notes.get("clipped", {}).get(name, 0))


def _add_depth(gathering: Gathering, image: ExrImage, passes: _Passes) -> None:
    for name in ("Depth", "Denoising Depth"):
        channel = next(iter(passes.get(name, {}).values()), None)
        if channel is None:
            continue
        far = HALF_MAX if image.precision[channel] == "half" else FAR
        depth = image.channels[channel][..., None]
        depth = np.where(depth >= far, np.float32(0), depth)
        gathering.put("depth", depth, str(image.path))
        gathering.note("channels", "depth", [f"{image.path.name}: {channel}"])
        if name == "Denoising Depth":
            gathering.note(
                "assumed", "depth", "Denoising Depth: length of the path to the first rough surface"
            )
        return


def _diffuse(image: ExrImage, passes: _Passes) -> Image | None:
    """Return what left the first hit as diffuse light, with emission; None without the passes for it."""
    total: Image | None = None
    for lobe in ("Diff", "Subsurface"):
        direct, indirect, color = (_pixels(image, passes, f"{lobe}{part}") for part in ("Dir", "Ind", "Col"))
        if direct is None or indirect is None or color is None:
            continue
        product = (direct + indirect) * color
        total = product if total is None else total + product
    if total is None:
        return None
    for name in ("Emit", "Env"):
        part = _pixels(image, passes, name)
        total = total if part is None else total + part
    return np.asarray(total, np.float32)


def _reference(gathering: Gathering, path: Path, layer: str) -> int | None:
    """Add the reference, and return its samples per pixel where the file says them."""
    image = read_exr(path)
    layers = _layers(image.channels)
    passes = layers.get(layer) or (next(iter(layers.values())) if len(layers) == 1 else {})
    if _add(gathering, "reference", image, passes, "Noisy Image", "Combined") is None:
        plain = [c for c in "RGB" if c in image.channels]
        if len(plain) < 3:
            found = ", ".join(list(image.channels)[:12])
            raise ValueError(f"{path}: missing reference (Combined of view layer {layer!r}); found {found}")
        gathering.add("reference", image, plain)
    diffuse = _diffuse(image, passes)
    if diffuse is not None:
        gathering.put("reference_diffuse", diffuse, str(path))
    return _spp(image, layer)


def _spp(image: ExrImage, layer: str) -> int | None:
    value = image.attributes.get(f"cycles.{layer}.samples")
    try:
        number = int(str(value))
    except ValueError:
        return None
    return number if number > 0 else None
