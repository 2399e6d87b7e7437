"""Samples kept apart in an EXR file: channels `s00.radiance.R`, `s00.normal.X`, … `s07.time.Z`."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.buffers import SAMPLE_BUFFERS, sample_channels
from data.exr_image import HALF_MAX, ExrImage
from data.frame import Samples
from data.repair import all_finite

_CHANNEL = re.compile(r"s(\d{2,4})\.(.+)")
_FOREIGN = {"color": "radiance", "albedo": "diffuse_albedo", "specular": "specular_albedo"}


def is_sample(channel: str) -> bool:
    """Return whether a channel belongs to one sample."""
    return _CHANNEL.fullmatch(channel) is not None


def read_samples(image: ExrImage, own: bool) -> tuple[Samples | None, int]:
    """Return the samples in a file, None where it has none, and how many values were not finite.

    Those values are replaced by the quantity's value for a ray that left the scene.

    Args:
        image: The file.
        own: We wrote it, so names are taken literally; otherwise `albedo` is the diffuse and `specular` the
            specular reflectance, and `color` the radiance.

    Raises:
        ValueError: Samples with different or unknown channels.
    """
    groups: dict[int, dict[str, str]] = {}
    for channel in image.channels:
        match = _CHANNEL.fullmatch(channel)
        if match:
            name, _, letter = match.group(2).rpartition(".")
            known = name if own else _FOREIGN.get(name, name)
            groups.setdefault(int(match.group(1)), {})[f"{known}.{letter}"] = channel
    if not groups:
        return None, 0
    names = [n for n in SAMPLE_BUFFERS if f"{n}.{SAMPLE_BUFFERS[n].letters[0]}" in groups[min(groups)]]
    channels = sample_channels(*names)
    values = np.empty((len(groups), *image.size, len(channels)), np.float32)
    for row, number in enumerate(sorted(groups)):
        found = groups[number]
        for column, channel in enumerate(channels):
            if channel not in found:
                raise ValueError(f"{image.path}: sample {number} has no channel {channel}, others have it")
            values[row, ..., column] = image.channels[found[channel]]
    return Samples(values, channels), _repair(values, channels)


def write_samples(samples: Samples) -> dict[str, NDArray[Any]]:
    """Return the channels of a file, half where the vocabulary and the range allow it.

    Raises:
        ValueError: A value is not finite.
    """
    result: dict[str, NDArray[Any]] = {}
    for column, channel in enumerate(samples.channels):
        plane = samples.values[..., column]
        if not np.isfinite(plane).all():
            raise ValueError(f"samples: channel {channel} holds NaN or Inf; repair it before writing")
        half = SAMPLE_BUFFERS[channel.partition(".")[0]].half and float(np.abs(plane).max()) <= HALF_MAX
        for number, image in enumerate(plane):
            result[f"s{number:02d}.{channel}"] = image.astype(np.float16 if half else np.float32)
    return result


def _repair(values: NDArray[np.float32], channels: tuple[str, ...]) -> int:
    if all_finite(values):
        return 0
    bad = ~np.isfinite(values)
    number = int(bad.sum())
    if number:
        fills = [SAMPLE_BUFFERS[channel.partition(".")[0]].no_hit for channel in channels]
        values[bad] = np.broadcast_to(np.asarray(fills, np.float32), values.shape)[bad]
    return number
