"""Samples kept apart in an EXR file: channels `s00.radiance.R`, `s00.normal.X`, … `s07.time.Z`.

Quantities and letters are those of `data.buffers.SAMPLE_BUFFERS`. Files that others wrote are understood as
well where samples are called `sample0` or `sample_0`, letters are `R`, `G`, `B` instead of `X`, `Y`, `Z` or
the other way round, a single channel has another letter or none, radiance is called `color`, `albedo` is the
diffuse reflectance, and `specular` the specular one, unless `diffuse` light stands beside it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data.buffers import SAMPLE_BUFFERS, sample_channels
from data.dropped import Dropped, mark, require_marked
from data.exr_image import HALF_MAX, ExrImage
from data.frame import Samples

KNOWN_SAMPLES = "s00.radiance.R, s00.normal.X … s07.time.Z, the samples of each pixel one after another"
"""How samples are named, for messages."""

_CHANNEL = re.compile(r"(?:s(?=\d\d)|sample_?)(\d{1,4})\.(.+)")
_FOREIGN = {"color": "radiance", "albedo": "diffuse_albedo", "specular": "specular_albedo"}
_LETTERS = {1: "ZYVRXA", 2: ("XY", "RG", "UV"), 3: ("RGB", "XYZ")}


class ReadSamples(NamedTuple):
    """The samples of a file.

    Attributes:
        samples: None where the file keeps none apart; those that do not count are marked (`data.dropped`).
        dropped: What does not count, None where every sample does.
        replaced: Infinite distances that became those of a ray that left the scene.
        ignored: Channels of samples that mean nothing here.
    """

    samples: Samples | None = None
    dropped: Dropped | None = None
    replaced: int = 0
    ignored: tuple[str, ...] = ()


def is_sample(channel: str) -> bool:
    """Return whether a channel belongs to one sample."""
    return _CHANNEL.fullmatch(channel) is not None


def read_samples(image: ExrImage, own: bool) -> ReadSamples:
    """Return the samples in a file.

    Args:
        image: The file.
        own: We wrote it, so names are taken literally; otherwise as the module says.

    Raises:
        ValueError: Samples with different channels, or none that is known.
    """
    groups: dict[int, dict[str, str]] = {}
    for channel in image.channels:
        match = _CHANNEL.fullmatch(channel)
        if match:
            groups.setdefault(int(match.group(1)), {})[match.group(2)] = channel
    if not groups:
        return ReadSamples()
    found = {number: _named(group, own) for number, group in sorted(groups.items())}
    channels = _channels(image, found)
    values = np.empty((len(found), *image.size, len(channels)), np.float32)
    for row, group in enumerate(found.values()):
        for column, channel in enumerate(channels):
            values[row, ..., column] = image.channels[group[channel]]
    used = {group[channel] for group in found.values() for channel in channels}
    ignored = {channel for group in groups.values() for channel in group.values()} - used
    return ReadSamples(Samples(values, channels), *mark(values, channels), tuple(sorted(ignored)))


def write_samples(samples: Samples) -> dict[str, NDArray[Any]]:
    """Return the channels of a file, half where the vocabulary and the range allow it.

    Raises:
        ValueError: A value is not finite, in a sample that is not marked as dropped.
    """
    require_marked(samples.values, samples.channels)
    result: dict[str, NDArray[Any]] = {}
    for column, channel in enumerate(samples.channels):
        plane = samples.values[..., column]
        largest = float(np.fmax.reduce(np.abs(plane), axis=None, initial=0))
        half = SAMPLE_BUFFERS[channel.partition(".")[0]].half and largest <= HALF_MAX
        for number, image in enumerate(plane):
            result[f"s{number:02d}.{channel}"] = image.astype(np.float16 if half else np.float32)
    return result


def _named(group: Mapping[str, str], own: bool) -> dict[str, str]:
    """Return name of the vocabulary, such as `normal.X` → channel of the file."""
    if own:
        return dict(group)
    layers: dict[str, dict[str, str]] = {}
    for name, channel in group.items():
        layer, dot, letter = name.rpartition(".")
        layers.setdefault(layer if dot else letter, {})[letter.upper() if dot else "Z"] = channel
    named: dict[str, str] = {}
    for layer, letters in layers.items():
        light = layer == "specular" and "diffuse" in layers
        name = layer if light else _FOREIGN.get(layer, layer)
        if name in SAMPLE_BUFFERS:
            expected = SAMPLE_BUFFERS[name].letters
            order = _order(letters, expected)
            pairs = zip(sample_channels(name), order, strict=True)
            named |= {known: letters[letter] for known, letter in pairs if letter in letters}
    return named


def _order(letters: Mapping[str, str], expected: tuple[str, ...]) -> Iterable[str]:
    """Return the letters of a quantity as a file has them, in the order of those that are expected."""
    orders: Iterable[Iterable[str]] = (expected, *_LETTERS.get(len(expected), ()))
    return next((order for order in orders if all(letter in letters for letter in order)), expected)


def _channels(image: ExrImage, found: Mapping[int, Mapping[str, str]]) -> tuple[str, ...]:
    """Return the channels that all samples have, in the order of the vocabulary."""
    held = {channel.partition(".")[0] for group in found.values() for channel in group}
    names = [name for name in SAMPLE_BUFFERS if name in held]
    if not names:
        some = ", ".join(list(next(iter(found.values())))[:6]) or "nothing that is known"
        raise ValueError(
            f"{image.path}: samples of each pixel with {some}; expected quantities of "
            f"{', '.join(SAMPLE_BUFFERS)}, named like {KNOWN_SAMPLES}"
        )
    channels = sample_channels(*names)
    for number, group in found.items():
        for channel in channels:
            if channel not in group:
                raise ValueError(f"{image.path}: sample {number} has no channel {channel}, others have it")
    return channels
