"""Altered EXR files: each must be read, or refused with a ValueError or OSError, whatever it says.

    python -m tests.fuzz.exr 20000        the figure of `make fuzz`
    python -m tests.fuzz.exr 1 SEED 1234  one input, in this process, with its traceback

Inputs are made from small files of all compressions and kinds: half, float and whole numbers, scan lines and
tiles, several parts, windows that differ, samples kept apart, deep. Attributes of the header, the table of
offsets, the heads of chunks and the compressed bytes are altered, bytes are cut off, inserted and doubled.
Each goes through what `trainer inspect`, `prepare`, `denoise` and the layouts do with a file.
"""

from __future__ import annotations

import random
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from data.exr import RadianceWarning, read_frame, read_stored
from data.exr_image import COPIES, SCRATCH, exr_channels, exr_extent, read_exr
from tests.fuzz import batches
from tests.fuzz.bytewise import Files, numbered, turned

FILE = "color.exr"
BOUND = SCRATCH
SLACK = 4 << 30
"""The library calls a file damaged where it gets no memory, so it gets more; what it took is looked at."""
KINDS = ("scanlineimage", "tiledimage", "deepscanline", "deeptile", "", "x" * 300)


def extra(folder: Path) -> int:
    """Return the bytes that reading a file may take beside `BOUND`, as `data.exr_image.COPIES` says."""
    try:
        rows, columns, channels = exr_extent(folder / FILE)
    except (ValueError, OSError):
        return 0
    return COPIES * 4 * rows * columns * channels


def read_all(folder: Path) -> None:
    """Do with a file what commands do.

    Raises:
        ValueError: It is refused.
        OSError: It is refused.
    """
    path = folder / FILE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RadianceWarning)
        warnings.simplefilter("ignore", RuntimeWarning)  # values of float32 that overflow
        exr_channels(path)
        exr_extent(path)
        image = read_exr(path)
        assert {array.shape for array in image.channels.values()} == {image.size}
        frame = read_frame(path)
        read_stored(path, lambda names: (list(names)[:1], list(names)[1:]))
        assert all(np.isfinite(a).all() for a in frame.buffers.values())


def bases() -> list[Files]:
    """Return the files that are altered."""
    made = [_written(header, channels) for header, channels in _plain()]
    made += [_written({"compression": OpenEXR.PIZ_COMPRESSION}, _buffers(), extra) for extra in _placed()]
    return [{FILE: data} for data in (*made, _parts(), _samples())]


def _plain() -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    names = [n for n in dir(OpenEXR) if n.endswith("_COMPRESSION") and not n.startswith("NUM")]
    for name in names:
        yield {"compression": getattr(OpenEXR, name)}, _buffers()
    for name in ("ZIP", "PIZ", "NO", "DWAA", "B44A", "PXR24"):
        tiles = OpenEXR.TileDescription()
        tiles.xSize, tiles.ySize, tiles.mode = 16, 8, OpenEXR.ONE_LEVEL
        tiled = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.tiledimage}
        yield {**tiled, "tiles": tiles}, _buffers()


def _placed() -> Iterator[dict[str, Any]]:
    yield {"dataWindow": _window(3, -5, 22, 18), "displayWindow": _window(0, 0, 29, 19)}
    yield {"lineOrder": OpenEXR.DECREASING_Y}


def _window(left: int, top: int, right: int, bottom: int) -> Any:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def _buffers() -> dict[str, Any]:
    generator = np.random.default_rng(1)
    noise = generator.random((24, 20))
    color = {f"color.{letter}": (noise * (i + 0.5)).astype("f2") for i, letter in enumerate("RGB")}
    return {**color, "depth.Z": noise.astype("f4"), "id": np.arange(480, dtype="u4").reshape(24, 20)}


def _written(header: dict[str, Any], channels: dict[str, Any], more: dict[str, Any] | None = None) -> bytes:
    own = {"penumbra": "1", "penumbra.scene": "hall", "penumbra.index": "3", "penumbra.exposure": "0.5"}
    return _file(({"type": OpenEXR.scanlineimage, **own, **header, **(more or {})}, channels))


def _parts() -> bytes:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), _buffers(), name=name) for name in ("left", "right")]
    return _file((parts,))


def _samples() -> bytes:
    plane = np.random.default_rng(2).random((24, 20)).astype("f2")
    channels = {f"s{n:02d}.radiance.{letter}": plane for n in range(2) for letter in "RGB"}
    return _written({"compression": OpenEXR.ZIPS_COMPRESSION}, channels)


def _file(arguments: tuple[Any, ...]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILE
        with OpenEXR.File(*arguments) as file:
            file.write(str(path))
        return path.read_bytes()


class Entry(NamedTuple):
    """One attribute of a header: where its value is."""

    name: str
    kind: str
    place: int
    size: int


@cache
def entries(data: bytes) -> tuple[tuple[Entry, ...], int]:
    """Return the attributes of all headers of a file that is as written, and where the offsets begin."""
    found, place = [], 8
    several = bool(data[5] & 0x10)
    while True:
        while data[place]:
            name, place = _word(data, place)
            kind, place = _word(data, place)
            size = int.from_bytes(data[place : place + 4], "little")
            found.append(Entry(name, kind, place + 4, size))
            place += 4 + size
        place += 1
        if not several or not data[place]:
            return tuple(found), place + several


def _word(data: bytes, place: int) -> tuple[str, int]:
    end = data.index(0, place)
    return data[place:end].decode(), end + 1


def mutated(made: list[Files], seed: int, number: int) -> Files:
    """Return input `number`: one of the files, altered in one to three places."""
    chance = random.Random(f"{seed} {number}")
    data = chance.choice(made)[FILE]
    known, offsets = entries(data)
    size = len(data)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        what = chance.random()
        if len(data) != size:  # places are no longer known
            data = turned(chance, data)
        elif what < 0.45:
            data = _attribute(chance, data, chance.choice(known))
        elif what < 0.55:
            data = numbered(chance, data, offsets + 8 * chance.randrange(4), 8)
        elif what < 0.65:
            start = int.from_bytes(data[offsets : offsets + 8], "little")
            place = start + 4 * chance.randrange(8)
            data = numbered(chance, data, place, 4) if place + 4 < len(data) else data
        elif what < 0.7:
            data = numbered(chance, data, 4 + chance.choice((0, 1, 1, 1)), 1)
        elif what < 0.8:
            data = turned(chance, data, 0, offsets)
        else:
            data = turned(chance, data, offsets)
    return {FILE: data}


def _attribute(chance: random.Random, data: bytes, entry: Entry) -> bytes:
    """Change the value of an attribute, its name, its type or its size."""
    way = chance.random()
    if way < 0.08:
        return numbered(chance, data, entry.place - 4, 4)
    if way < 0.14:
        return turned(chance, data, entry.place - 4 - len(entry.kind) - 1, entry.place - 4)
    if entry.kind == "string" and way < 0.4:
        text = chance.choice(KINDS).encode()
        return (
            data[: entry.place - 4]
            + len(text).to_bytes(4, "little")
            + text
            + data[entry.place + entry.size :]
        )
    if entry.kind == "chlist":
        return _channel(chance, data, entry)
    if entry.kind in ("compression", "lineOrder"):
        return data[: entry.place] + bytes([chance.choice((*range(15), 127, 255))]) + data[entry.place + 1 :]
    if entry.size >= 4 and way < 0.9:
        return numbered(chance, data, entry.place + chance.randrange(0, entry.size - 3, 4), 4)
    return turned(chance, data, entry.place, entry.place + entry.size)


def _channel(chance: random.Random, data: bytes, entry: Entry) -> bytes:
    """Change the name, type or sampling of a channel."""
    place, starts, end = entry.place, [], entry.place + entry.size
    while place < end and data[place] and (zero := data.find(0, place)) >= 0:
        starts.append((place, zero + 1))
        place = zero + 17
    if not starts:  # altered before
        return turned(chance, data, entry.place, end)
    name, numbers = chance.choice(starts)
    if chance.random() < 0.7 and numbers + 16 <= len(data):
        return numbered(chance, data, numbers + 4 * chance.choice((0, 0, 2, 3)), 4)
    return turned(chance, data, name, min(numbers, len(data)))


def run(count: int, seed: int = 1) -> dict[str, int]:
    """Read `count` altered files; see `batches.run`."""
    return batches.run("exr", count, seed)


def main(words: list[str]) -> None:
    """Run from the command line; see above."""
    numbers = [int(word) for word in words] or [20_000]
    if len(numbers) == 3:
        read_all(batches.keep("exr", *numbers[1:]))
    else:
        print(run(*numbers))


if __name__ == "__main__":
    main(sys.argv[1:])
