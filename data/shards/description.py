"""What a sample says about itself, read from bytes that may be anything.

Nothing that is read here is trusted: names, shapes and places are checked against the vocabulary and against
the bytes of the sample, so that no reader looks beyond them or allocates more than they justify. Reading a
description takes at most `LARGEST_TEXT` bytes of JSON; the arrays of a sample do not overlap, so all of them
as float32 take at most twice the bytes of the sample.
"""

from __future__ import annotations

import json
import math
import tarfile
from typing import Any, NamedTuple

import torch

from data.buffers import BUFFERS, SAMPLES, THIN_LENS, sample_channels
from data.shards.options import LONGEST_CLIP

DTYPES = {"<f2": torch.float16, "<f4": torch.float32}
LARGEST_TEXT = 1 << 20
LARGEST_SIDE = 1 << 17
"""Pixels of a row or column of a frame, at most."""


class Stored(NamedTuple):
    """Where an array of a sample lies: type, shape, and first value, counted in that type from the beginning
    of the sample. The shape is (C, H, W), (S, C, H, W) of `samples`, (N, C, H, W) in a clip of N frames."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int


class Sample(NamedTuple):
    """What is known of a sample beside its pixels.

    Of a clip, `frame` and `exposure` are those of its first frame, and `depth_range` has a pair for each.
    """

    key: str
    scene: str
    frame: int
    exposure: float
    depth_range: tuple[float, ...]
    accumulated: bool
    height: int
    width: int
    shard: int
    buffers: dict[str, Stored]
    sample_channels: tuple[str, ...] = ()
    thin_lens: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frames: int = 1


def parse(key: str, raw: memoryview, shard: int) -> Sample:
    """Read the two tar headers and the JSON of a sample.

    Args:
        key: Name of the sample.
        raw: All its bytes, headers included.
        shard: Number of its shard, to be noted.

    Raises:
        ValueError: It is not what `data.shards.write` writes; says what is wrong.
    """
    block = tarfile.BLOCKSIZE
    if len(raw) < 2 * block:
        raise ValueError(f"{len(raw)} bytes are too few")
    length = _octal(bytes(raw[124:136]))
    start = 2 * block + length + -length % block
    if not 0 < length <= LARGEST_TEXT or start > len(raw):
        raise ValueError(f"its description cannot have {length} bytes")
    try:
        meta = json.loads(bytes(raw[block : block + length]))
    except RecursionError as error:
        raise ValueError("its description is nested too deeply") from error
    try:
        return _sample(key, meta, shard, start, len(raw))
    except KeyError as error:
        raise ValueError(f"it does not say its {error}") from error
    except (TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"its description has a value of another type ({error})") from error


def _octal(field: bytes) -> int:
    digits = field.rstrip(b" \0")
    if not digits or digits.strip(b"01234567"):
        raise ValueError("its header is no header of a tar file")
    return int(digits, 8)


def _sample(key: str, meta: dict[str, Any], shard: int, start: int, end: int) -> Sample:
    height, width = (whole(meta[name], name, 1, LARGEST_SIDE) for name in ("height", "width"))
    channels = tuple(text(name, "sample_channels") for name in meta.get("sample_channels", ()))
    if channels != sample_channels(*dict.fromkeys(name.partition(".")[0] for name in channels)):
        raise ValueError("its sample_channels are not those of known quantities, one after another")
    frames = whole(meta.get("frames", 1), "frames", 1, LONGEST_CLIP)
    buffers: dict[str, Stored] = {}
    free = start
    for entry in meta["buffers"]:
        name, stored, size = _stored(entry, start, (height, width), len(channels), frames)
        first = stored.start * stored.dtype.itemsize
        if first < free or first + size > end or name in buffers:
            raise ValueError(f"{name} does not lie within the sample and beside its other buffers")
        buffers[name], free = stored, first + size
    if not buffers:
        raise ValueError("it has no buffers")
    aperture, focus, view = (number(value, THIN_LENS) for value in meta.get(THIN_LENS, (0.0, 0.0, 0.0)))
    return Sample(
        key,
        text(meta["scene"], "scene"),
        whole(meta["frame"], "frame", -(2**62), 2**62),
        number(meta["exposure"], "exposure"),
        _depth_range(meta["depth_range"], frames),
        bool(meta["accumulated"]),
        height,
        width,
        shard,
        buffers,
        channels,
        (aperture, focus, view),
        frames,
    )


def _depth_range(told: Any, frames: int) -> tuple[float, ...]:
    pairs = [told] if frames == 1 else told
    if len(pairs) != frames:
        raise ValueError(f"its depth_range has {len(pairs)} pairs, expected {frames}")
    return tuple(number(value, "depth_range") for low, high in pairs for value in (low, high))


def _stored(
    entry: dict[str, Any], start: int, size: tuple[int, int], channels: int, frames: int
) -> tuple[str, Stored, int]:
    """Return name, place and bytes of an array."""
    name, dtype = text(entry["name"], "name"), DTYPES.get(text(entry["dtype"], "dtype"))
    if dtype is None:
        raise ValueError(f"{name} has type {entry['dtype']!r}, expected {' or '.join(DTYPES)}")
    shape = tuple(whole(side, "shape", 1, LARGEST_SIDE) for side in entry["shape"])
    expected = channels if name == SAMPLES else BUFFERS[name].channels if name in BUFFERS else None
    if len(shape) != (4 if name == SAMPLES or frames > 1 else 3) or shape[-2:] != size:
        raise ValueError(f"{name} has the shape {shape}, in a sample of {size[0]} rows and {size[1]} columns")
    if frames > 1 and (name == SAMPLES or shape[0] != frames):
        raise ValueError(f"{name} has the shape {shape}, in a clip of {frames} frames")
    if expected is not None and shape[-3] != expected:
        raise ValueError(f"{name} has {shape[-3]} channels, expected {expected}")
    first = start + whole(entry["offset"], "offset", 0, 2**48)
    if first % dtype.itemsize:
        raise ValueError(f"{name} begins at byte {entry['offset']}, no multiple of {dtype.itemsize}")
    return name, Stored(dtype, shape, first // dtype.itemsize), math.prod(shape) * dtype.itemsize


def whole(value: Any, name: str, least: int, most: int) -> int:
    """Return a whole number that was read.

    Raises:
        ValueError: It is none, or out of range.
    """
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{name} is {_short(value)}, expected a whole number from {least} to {most}")
    return value


def number(value: Any, name: str) -> float:
    """Return a finite number that was read, as 32 bits hold it.

    Raises:
        ValueError: It is none.
    """
    if type(value) not in (int, float) or not abs(value) <= 3.4e38:
        raise ValueError(f"{name} is {_short(value)}, expected a finite number")
    return float(value)


def text(value: Any, name: str, most: int = 4096) -> str:
    """Return a text that was read.

    Raises:
        ValueError: It is none, or longer than `most`.
    """
    if not isinstance(value, str) or len(value) > most:
        raise ValueError(f"{name} is {_short(value)}, expected a text of at most {most} characters")
    return value


def _short(value: Any) -> str:
    if isinstance(value, int) and not -(2**64) < value < 2**64:  # whose decimal form may be refused
        return "a number of many digits"
    said = repr(value) if not isinstance(value, list | dict) else type(value).__name__
    return said if len(said) <= 60 else f"{said[:57]}…"
