"""Tiles of SBMC's data sets: a header, the converged pixel data, and every sample with its path.

    int32 version, tile size, image width, height, samples, samples of the reference,
          features per sample (27), features per pixel (30), path vertices (6)
    float32 focus distance, aperture radius, field of view, scene radius
    int32 block x, y: the tile's first column and row in the image
    blocks: int32 length, LZ4 frame of that length
        float32 (30, size, size): 15 means, then 15 variances of the mean
        per sample: float32 (27 + 24 + 12, size, size), then int16 (6, size, size) of flags

Everything is little-endian. A block is decompressed to its known size and not a byte further.

Source: Gharbi et al. 2019, doi:10.1145/3306346.3322954; order and units as in the authors' reader and their
renderer.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

VERSIONS = (20181212, 20190401)
VERTICES = 6
FLAGS = 5
SAMPLE_FEATURES = 27
PIXEL_FEATURES = 30
PATH_FEATURES = (4 + 2) * VERTICES

MAX_TILE = 4096
MAX_IMAGE = 1 << 16
MAX_SAMPLES = 1 << 14
MAX_RATIO = 256
"""Largest ratio of decompressed to compressed bytes: LZ4 reaches 255."""

_HEADER = struct.Struct("<9i4f2i")
_NAMES = (
    "version",
    "tile_size",
    "image_width",
    "image_height",
    "sample_count",
    "gt_sample_count",
    "sample_features",
    "pixel_features",
    "path_depth",
    "focus_distance",
    "aperture_radius",
    "fov",
    "scene_radius",
    "block_x",
    "block_y",
)


@dataclass(frozen=True)
class TileHeader:
    """Header of a tile.

    Attributes:
        version: Version of the format.
        tile_size: Width and height of the tile.
        image_width: Width of the image that the tile is a part of.
        image_height: Its height.
        sample_count: Samples per pixel in the file.
        gt_sample_count: Samples per pixel of the pixel data, the reference.
        sample_features: 27.
        pixel_features: 30.
        path_depth: 6.
        focus_distance: In units of ten scene radii, 0 for a pinhole camera.
        aperture_radius: In units of ten scene radii, 0 for a pinhole camera.
        fov: Field of view in degrees.
        scene_radius: In scene units.
        block_x: First column in the image.
        block_y: First row in the image.
    """

    version: int
    tile_size: int
    image_width: int
    image_height: int
    sample_count: int
    gt_sample_count: int
    sample_features: int
    pixel_features: int
    path_depth: int
    focus_distance: float
    aperture_radius: float
    fov: float
    scene_radius: float
    block_x: int
    block_y: int

    @property
    def pixel_bytes(self) -> int:
        """Size of the pixel data, decompressed."""
        return self.pixel_features * self.tile_size**2 * 4

    @property
    def sample_bytes(self) -> int:
        """Size of one sample, decompressed."""
        return ((self.sample_features + PATH_FEATURES) * 4 + VERTICES * 2) * self.tile_size**2


@dataclass(frozen=True)
class Tile:
    """Content of a tile.

    Attributes:
        header: Its header.
        pixels: Means, then variances of the mean (30, size, size): diffuse 3, specular 3, albedo 3, normal 3,
            depth, visibility, hit.
        samples: (S, 63, size, size): pixel offset 2, lens 2, time, diffuse 3, specular 3, first normal 3,
            normal 3, first depth, depth, visibility, hit, first albedo 3, albedo 3, then 4 probabilities and
            2 angles of each of the 6 vertices.
        flags: int16 (S, 6, size, size): bits 0 to 4 are reflection, transmission, diffuse, glossy, specular.
    """

    header: TileHeader
    pixels: NDArray[np.float32]
    samples: NDArray[np.float32]
    flags: NDArray[np.int16]


def read_header(path: Path) -> TileHeader:
    """Read and check the header of a tile.

    Raises:
        OSError: The file cannot be opened.
        ValueError: It is too short, of another version, or a number is not plausible; names file and field.
    """
    with path.open("rb") as file:
        return _header(path, file)


def read_tile(path: Path) -> Tile:
    """Read a tile.

    Raises:
        OSError: The file cannot be opened.
        ValueError: The header is not plausible, a block is truncated, damaged or of another size, or lz4 is
            not installed; the message then says how to install it.
    """
    with path.open("rb") as file:
        header = _header(path, file)
        size, count = header.tile_size, header.sample_count
        _check_size(path, header)
        pixels = np.frombuffer(_block(path, file, "the pixel data", header.pixel_bytes), "<f4")
        floats = (header.sample_features + PATH_FEATURES) * size * size
        samples = np.empty((count, floats), np.float32)
        flags = np.empty((count, VERTICES * size * size), np.int16)
        for number in range(count):
            content = _block(path, file, f"sample {number}", header.sample_bytes)
            samples[number] = np.frombuffer(content, "<f4", floats)
            flags[number] = np.frombuffer(content, "<i2", offset=floats * 4)
    return Tile(
        header,
        pixels.astype(np.float32).reshape(-1, size, size),
        samples.reshape(count, -1, size, size),
        flags.reshape(count, VERTICES, size, size),
    )


def _header(path: Path, file: BinaryIO) -> TileHeader:
    content = file.read(_HEADER.size)
    if len(content) < _HEADER.size:
        raise ValueError(f"{path}: {len(content)} bytes, the header of a tile alone has {_HEADER.size}")
    values = dict(zip(_NAMES, _HEADER.unpack(content), strict=True))
    if values["version"] not in VERSIONS:
        known = ", ".join(str(v) for v in VERSIONS)
        raise ValueError(f"{path}: version is {values['version']}, expected {known}: not a tile of SBMC")
    exact = {"sample_features": SAMPLE_FEATURES, "pixel_features": PIXEL_FEATURES, "path_depth": VERTICES}
    for name, expected in exact.items():
        if values[name] != expected:
            raise ValueError(f"{path}: {name} is {values[name]}, expected {expected}")
    limits = {
        "tile_size": (1, MAX_TILE),
        "image_width": (1, MAX_IMAGE),
        "image_height": (1, MAX_IMAGE),
        "sample_count": (1, MAX_SAMPLES),
        "gt_sample_count": (0, 1 << 30),
        "block_x": (0, MAX_IMAGE),
        "block_y": (0, MAX_IMAGE),
    }
    for name, (low, high) in limits.items():
        if not low <= values[name] <= high:
            raise ValueError(f"{path}: {name} is {values[name]}, expected {low} to {high}")
    if values["aperture_radius"] == 0:
        # Pinhole cameras have NaN here, which the authors' reader replaces too.
        values["focus_distance"] = 0.0
    for name in ("focus_distance", "aperture_radius", "fov", "scene_radius"):
        if not (math.isfinite(values[name]) and values[name] >= 0):
            raise ValueError(f"{path}: {name} is {values[name]}, expected a number >= 0")
    return TileHeader(**values)


def _check_size(path: Path, header: TileHeader) -> None:
    """Refuse a header that claims more than the file can hold, before any memory is taken."""
    stored = path.stat().st_size - _HEADER.size
    claimed = header.pixel_bytes + header.sample_count * header.sample_bytes
    if claimed > max(stored, 0) * MAX_RATIO:
        raise ValueError(
            f"{path}: truncated or damaged: {header.sample_count} samples of {header.tile_size}x"
            f"{header.tile_size} pixels need {claimed} bytes, which {stored} compressed ones cannot hold"
        )


def _block(path: Path, file: BinaryIO, what: str, size: int) -> bytes:
    try:
        import lz4.frame
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{path} is read with lz4, which is not installed: pip install penumbra-denoise[layouts]"
        ) from error
    prefix = file.read(4)
    length = int.from_bytes(prefix, "little", signed=True) if len(prefix) == 4 else 0
    left = path.stat().st_size - file.tell()
    if not 0 < length <= left:
        raise ValueError(
            f"{path}: the block of {what} has {length} bytes, {left} are left: truncated or damaged"
        )
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        content = bytes(decompressor.decompress(file.read(length), max_length=size))
        beyond = b"" if decompressor.eof else decompressor.decompress(b"", max_length=1)
    except (RuntimeError, EOFError) as error:
        raise ValueError(f"{path}: the block of {what} is damaged ({error})") from error
    if len(content) != size or beyond or not decompressor.eof:
        amount = "more" if beyond or len(content) == size else f"{len(content)}"
        raise ValueError(
            f"{path}: the block of {what} has {amount} bytes, expected {size}: truncated or damaged"
        )
    return content
