"""Frames as EXR files: which channel is which buffer, header attributes, repairs and warnings.

Our own files name channels `<buffer>.<letter>` with the words of `data.buffers` and carry scene, index,
camera, exposure and samples per pixel as header attributes, so that one file is self-contained. Foreign
files are understood where their names are close enough (see `KNOWN_NAMINGS`).
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import BUFFERS, SAMPLES, THIN_LENS, buffer
from data.camera import Camera
from data.dropped import mean
from data.exr_image import HALF_FLOOR as HALF_FLOOR
from data.exr_image import HALF_MAX as HALF_MAX
from data.exr_image import ExrImage as ExrImage
from data.exr_image import read_exr as read_exr
from data.exr_image import write_exr as write_exr
from data.exr_samples import KNOWN_SAMPLES, ReadSamples, is_sample, read_samples, write_samples
from data.frame import Frame, Image
from data.repair import all_finite, repair

KNOWN_NAMINGS = (
    "<buffer>.R/.G/.B, .X/.Y/.Z or .Z with the buffers color, irradiance, albedo, diffuse_albedo, "
    "specular_albedo, normal, depth, position, motion, reference …; the same with A, B or Variance after the "
    "buffer (colorA.R, colorVariance.R); plain R, G, B in a file named after its buffer "
    "(color0.exr, albedo0.exr, shading_normal0.exr, world_position0.exr, reference0.exr); "
    f"{KNOWN_SAMPLES}"
)

_MARK = "penumbra"
_LETTERS = {1: ("Z", "Y", "V", "R", "X", "A"), 2: ("XY", "RG", "UV"), 3: ("RGB", "XYZ")}
_STEMS = {
    "albedo": "albedo",
    "color": "color",
    "irradiance": "irradiance",
    "reference": "reference",
    "shading_normal": "normal",
    "normal": "normal",
    "world_position": "position",
    "position": "position",
    "depth": "depth",
}


Halves = NDArray[np.float16]
"""A buffer as half precision files hold it, finite, channels first (C, H, W)."""

Choose = Callable[[Collection[str]], tuple[Collection[str], Collection[str]]]


class StoredFrame(NamedTuple):
    """A frame of which only what is computed with was converted to float32.

    Attributes:
        frame: The frame with those buffers.
        halves: Name → a buffer as it is stored, in half precision.
    """

    frame: Frame
    halves: dict[str, Halves]


class RadianceWarning(UserWarning):
    """A radiance buffer looks as if it came from an 8-bit or tone-mapped image."""


def read_frame(path: str | Path, only: str | None = None, layers: Mapping[str, str] | None = None) -> Frame:
    """Read a frame from one EXR file.

    Values that are not finite are replaced by each buffer's policy and counted in `notes["repaired"]`; pixels
    outside the data window become `no_hit`. `notes["channels"]` says which channels became which buffer,
    `notes["precision"]` how they were stored, and `notes["ignored"]` lists channels without a meaning here.

    Args:
        path: The file. Without our header attributes, scene and index come from its folder and name.
        only: The buffer that a file with plain R, G, B holds; taken from the file's name where None.
        layers: Layer of the file → the buffer that it is, where its name does not say so.

    Raises:
        OSError: The file cannot be opened.
        ValueError: It cannot be read as a frame: damaged, no EXR, unknown or incomplete channel names; or it
            lacks a layer that `layers` names.

    Warns:
        RadianceWarning: Radiance that looks 8-bit or tone-mapped.
    """
    return _read(Path(path), only, None, layers=layers).frame


def read_stored(path: str | Path, choose: Choose, samples: bool = True) -> StoredFrame:
    """Read some of the buffers of a frame in our own naming, and convert no more than is computed with.

    Args:
        path: The file.
        choose: Called with the names of the buffers in the file; returns those that are needed in float32,
            and those that are passed on as they are stored where that is in half precision.
        samples: Whether to read samples that are kept apart.

    Returns:
        The frame has the former in float32, its pixels lying channel by channel, and those of the latter
        that are stored otherwise, do not fill the display window or had to be repaired.

    Raises:
        OSError: As `read_frame`.
        ValueError: As `read_frame`.
    """
    return _read(Path(path), None, choose, samples)


def _read(
    path: Path,
    only: str | None,
    choose: Choose | None,
    with_samples: bool = True,
    layers: Mapping[str, str] | None = None,
) -> StoredFrame:
    image = _renamed(read_exr(path, keep_half=True), layers or {})
    own = _MARK in image.attributes
    groups, ignored = _groups(image, only, any(map(is_sample, image.channels)))
    kept = read_samples(image, own) if with_samples or not groups else ReadSamples()
    halves: dict[str, Halves] = {}
    if choose is not None and groups and own:
        groups, halves = _chosen(image, groups, choose)
    buffers, outside = {}, {}
    for name, channels in groups.items():
        buffers[name], hidden = _converted(image, name, channels, planar=choose is not None)
        if hidden:
            outside[name] = hidden
    if kept.samples is not None and not buffers:
        buffers["color"] = mean(kept.samples.get("radiance"))
    buffers, repaired = repair(buffers)
    if kept.replaced:
        repaired[SAMPLES] = kept.replaced
    ignored = sorted((*ignored, *kept.ignored))
    frame = replace(_described(path, image, buffers), samples=kept.samples)
    frame.notes["channels"] = groups
    frame.notes["precision"] = {n: _precision(image, channels) for n, channels in groups.items()}
    told: dict[str, Any] = {"repaired": repaired, "ignored": ignored, "outside_data_window": outside}
    if kept.dropped is not None:
        told["dropped"] = list(kept.dropped)
    frame.notes |= {key: value for key, value in told.items() if value}
    if not own:  # our own files were looked at when they were made
        for name, array in buffers.items():
            _warn_unless_radiance(path, name, array)
    return StoredFrame(frame, halves)


def _renamed(image: ExrImage, layers: Mapping[str, str]) -> ExrImage:
    """Return the image with other names of layers; those of the same name that were there are left out."""
    if not layers:
        return image
    found = {channel: channel.rpartition(".")[0] for channel in image.channels}
    if missing := [layer for layer in layers if layer not in found.values()]:
        there = ", ".join(dict.fromkeys(layer or "(none)" for layer in found.values()))
        raise ValueError(f"{image.path}: there is no layer {missing[0]!r}; the layers are {there}")
    names = {}
    for channel, layer in found.items():
        if layer in layers:
            names[channel] = f"{layers[layer]}.{channel.rpartition('.')[2]}"
        elif layer not in layers.values():
            names[channel] = channel
    return replace(
        image,
        channels={names[c]: array for c, array in image.channels.items() if c in names},
        precision={names[c]: stored for c, stored in image.precision.items() if c in names},
        outside={names[c]: hidden for c, hidden in image.outside.items() if c in names},
    )


def _chosen(
    image: ExrImage, groups: dict[str, list[str]], choose: Choose
) -> tuple[dict[str, list[str]], dict[str, Halves]]:
    """Return the channels of the buffers to convert, at least one, and those that stay in half precision."""
    computed, passed = choose(groups.keys())
    halves = {}
    for name in passed:
        planes = [image.channels[channel] for channel in groups.get(name, ())]
        kept = planes and all(p.dtype == np.float16 and all_finite(p) for p in planes)
        if kept and not image.outside.keys() & set(groups[name]):
            halves[name] = np.stack(planes)
    wanted = {*computed, *passed} - (halves.keys() - set(computed))
    found = {name: channels for name, channels in groups.items() if name in wanted}
    return found or dict([next(iter(groups.items()))]), halves


def _converted(image: ExrImage, name: str, channels: list[str], planar: bool) -> tuple[Image, int]:
    """Return a buffer (H, W, C) and how many of its pixels lie outside the data window."""
    shape = image.channels[channels[0]].shape
    if planar:
        array = np.empty((len(channels), *shape), np.float32).transpose(1, 2, 0)
    else:
        array = np.empty((*shape, len(channels)), np.float32)
    for i, channel in enumerate(channels):
        array[..., i] = image.channels[channel]
    hidden = image.outside.get(channels[0])
    if hidden is None:
        return array, 0
    np.copyto(array, np.asarray(buffer(name).no_hit, np.float32), where=hidden[..., None])
    return array, int(hidden.sum())


def write_frame(
    frame: Frame, path: str | Path, only: Iterable[str] | None = None, single: bool = False
) -> dict[str, str]:
    """Write a frame as one EXR file in our naming, whole or not at all.

    Half precision where the vocabulary allows it and the range fits (no value above 65504, and not all so
    small that they would lie among the subnormal numbers), and where it loses nothing; float32 otherwise.

    Args:
        frame: What to write, with scene, index, camera, exposure and spp in header attributes.
        path: Target.
        only: Names of the buffers to write; None: all of the frame, and its samples.
        single: Write all buffers as float32.

    Returns:
        Buffer → `half` or `float`, as written.

    Raises:
        ValueError: A named buffer is missing, or a buffer holds NaN or infinities.
        OSError: The file cannot be written; nothing is left behind.
    """
    names = list(frame.buffers if only is None else only)
    frame.require(*names)
    channels: dict[str, NDArray[Any]] = {}
    precision = {}
    for name in names:
        entry, array = buffer(name), frame.buffers[name]
        if not np.isfinite(array).all():
            raise ValueError(
                f"{frame.label}: buffer {name!r} holds NaN or Inf; repair it before writing {path}"
            )
        half = not single and (_half_holds(array) if entry.half else _half_is_exact(array))
        precision[name] = "half" if half else "float"
        for i, letter in enumerate(entry.letters):
            channels[f"{name}.{letter}"] = array[..., i].astype(np.float16 if half else np.float32)
    if frame.samples is not None and only is None:
        channels |= write_samples(frame.samples)
    write_exr(path, channels, _attributes(frame))
    return precision


def _half_holds(array: Image) -> bool:
    largest = float(np.abs(array).max(initial=0))
    return largest == 0 or HALF_FLOOR <= largest <= HALF_MAX


def _half_is_exact(array: Image) -> bool:
    small = float(np.abs(array).max(initial=0)) <= HALF_MAX
    return small and np.array_equal(array.astype(np.float16), array)


def _attributes(frame: Frame) -> dict[str, Any]:
    numbers = {"exposure": frame.exposure, "spp": frame.spp}
    kept = {k: v for k, v in frame.notes.items() if k not in ("channels", "precision", "ignored")}
    return {
        _MARK: "1",
        f"{_MARK}.scene": frame.scene,
        f"{_MARK}.index": str(frame.index),
        f"{_MARK}.accumulated": json.dumps(frame.accumulated),
        **{f"{_MARK}.{k}": repr(v) for k, v in numbers.items() if v is not None},
        **({f"{_MARK}.camera": json.dumps(frame.camera.to_json())} if frame.camera else {}),
        **({f"{_MARK}.{THIN_LENS}": json.dumps(frame.thin_lens)} if frame.thin_lens else {}),
        **({f"{_MARK}.notes": json.dumps(kept)} if kept else {}),
    }


def _described(path: Path, image: ExrImage, buffers: dict[str, Image]) -> Frame:
    number = re.search(r"(\d+)(?=\D*$)", path.stem)
    header = {
        k.removeprefix(f"{_MARK}."): v for k, v in image.attributes.items() if k.startswith(f"{_MARK}.")
    }
    try:
        return Frame(
            buffers,
            scene=header.get("scene", path.resolve().parent.name),
            index=int(header.get("index") or (number.group(1) if number else 0)),
            camera=Camera.from_json(json.loads(header["camera"])) if "camera" in header else None,
            exposure=float(header["exposure"]) if "exposure" in header else None,
            spp=int(header["spp"]) if "spp" in header else None,
            accumulated=bool(json.loads(header.get("accumulated", "false"))),
            notes=dict(json.loads(header.get("notes", "{}"))),
            thin_lens=_numbers(header.get(THIN_LENS)),
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: cannot understand the file's header or buffers: {error}") from error


def _numbers(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    aperture, focus, view = json.loads(text)
    return float(aperture), float(focus), float(view)


def _groups(
    image: ExrImage, only: str | None, sampled: bool = False
) -> tuple[dict[str, list[str]], list[str]]:
    """Return buffer → channels in order, and the channels that mean nothing here."""
    layers: dict[str, dict[str, str]] = {}
    for channel in image.channels:
        if sampled and is_sample(channel):
            continue
        layer, _, letter = channel.rpartition(".")
        layers.setdefault(layer, {})[letter.upper()] = channel
    groups: dict[str, list[str]] = {}
    ignored: list[str] = []
    for layer, letters in layers.items():
        name = _name(image, layer, layers, only)
        channels = None if name is None else _ordered(image.path, name, letters)
        if name is None or channels is None:
            ignored += letters.values()
        elif name in groups:
            raise ValueError(f"{image.path}: both {groups[name]} and {channels} name the buffer {name!r}")
        else:
            groups[name] = channels
            ignored += [c for c in letters.values() if c not in channels]
    if not groups and not sampled:
        found = ", ".join(ignored[:12]) + (f" and {len(ignored) - 12} more" if len(ignored) > 12 else "")
        raise ValueError(f"{image.path}: unknown channel naming: {found}. Known: {KNOWN_NAMINGS}")
    return groups, sorted(ignored)


def _name(image: ExrImage, layer: str, layers: Mapping[str, Any], only: str | None) -> str | None:
    if not layer:
        return only or _by_file_name(image.path, layers)
    if _MARK in image.attributes:
        return layer if layer in BUFFERS else None
    name = re.sub(r"(?<=[a-z])(A|B)$", lambda m: f"_{m.group(1).lower()}", layer)
    name = re.sub(r"(?<=[a-z])Variance$", "_variance", name)
    name = {"referenceDiffuse": "reference_diffuse"}.get(name, name)
    base, _, suffix = name.partition("_") if name.endswith(("_a", "_b", "_variance")) else (name, "", "")
    if base == "albedo" and _is_reflectance(image, layers):
        base = "diffuse_albedo"
    if base == "specular" and {"albedo", "roughness"} <= layers.keys():
        base = "specular_albedo"
    name = f"{base}_{suffix}" if suffix else base
    return name if name in BUFFERS else None


def _is_reflectance(image: ExrImage, layers: Mapping[str, Mapping[str, str]]) -> bool:
    """Tell a renderer's albedo, 0 on lamps and mirrors, from what irradiance was divided by."""
    if "irradiance" in layers or "albedo" not in layers:
        return False
    if {"specular", "roughness"} <= layers.keys():
        return True
    return any(
        (image.channels[c][~image.outside[c]] if c in image.outside else image.channels[c]).min(initial=1)
        <= 0
        for c in layers["albedo"].values()
    )


def _by_file_name(path: Path, layers: Mapping[str, Any]) -> str:
    if len(layers) > 1:
        return "color"
    return _STEMS.get(re.sub(r"[\d._-]+$", "", path.stem).lower(), "color")


def _ordered(path: Path, name: str, letters: Mapping[str, str]) -> list[str] | None:
    count = buffer(name).channels
    for order in (*_LETTERS.get(count, ()), buffer(name).letters):
        if all(letter in letters for letter in order):
            return [letters[letter] for letter in order]
    if (
        name.endswith("_variance")
        or count not in _LETTERS
        or (count == 3 and not {"R", "G", "B", "X"} & letters.keys())
    ):
        return None
    if count == 1 and letters:
        return [next(iter(letters.values()))]
    found = ", ".join(sorted(letters.values()))
    raise ValueError(f"{path}: buffer {name!r} needs the channels {buffer(name).letters}, found only {found}")


def _precision(image: ExrImage, channels: list[str]) -> str:
    kinds = {image.precision[c] for c in channels}
    return kinds.pop() if len(kinds) == 1 else "mixed"


def _warn_unless_radiance(path: Path, name: str, array: Image) -> None:
    if buffer(name).kind != "radiance" or array.size == 0 or float(array.max()) > 1:
        return
    reason = looks_encoded(array)
    if reason:
        warnings.warn(
            f"{path}: buffer {name!r} {reason}; linear radiance is expected, render to half or float EXR",
            RadianceWarning,
            stacklevel=3,
        )


def looks_encoded(array: Image) -> str | None:
    """Return why an image looks 8-bit or clipped by a tone map, None for plausible radiance.

    8-bit: at least 64 values that are not 0, at most 256 different ones, all of them k/255 directly, or after
    sRGB or gamma 2.2 encoding. Clipped: nothing above 1 and at least one value in two hundred exactly 1.
    """
    values = array[array > 0]
    if values.size < 64 or float(values.max()) > 1:
        return None
    levels = np.unique(values)
    if 8 <= levels.size <= 256:
        srgb = np.where(levels <= 0.0031308, 12.92 * levels, 1.055 * levels ** (1 / 2.4) - 0.055)
        for code in (levels, srgb, levels ** (1 / 2.2)):
            scaled = code * 255
            if (np.abs(scaled - np.round(scaled)) < 0.07).all():
                return f"has only {levels.size} levels, those of an 8-bit image"
    if levels.size >= 64 and float((values == 1).mean()) >= 0.005:
        return (
            f"is clipped at 1 ({100 * float((values == 1).mean()):.1f} % of its values), as after a tone map"
        )
    return None
