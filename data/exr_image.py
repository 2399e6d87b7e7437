"""OpenEXR files as plain channels: what the library returns, checked, composed, written whole or not.

Traps of the library (OpenEXR 3.3 to 3.5, its Python module) that this file deals with: channels X, Y, Z are
merged unless asked not to; the dictionary given for writing is modified, strides of its arrays are ignored; a
file with damaged pixels raises nothing, prints a line and has fewer parts; headers are emptied when the file
is closed; pixels outside the data window are the reader's business; memory is allocated for whatever size a
header claims.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from data.muted import muted

HALF_MAX = 65504.0
"""Largest finite half precision number; larger values are stored in float32."""

HALF_FLOOR = 2.0**-8
"""Images that nowhere exceed this, but are not zero, are stored in float32: below it half precision has fewer
than eleven bits for much of a picture's range."""

MAX_BYTES = 1 << 34
"""Largest image that is read, as float32."""

COPIES = 4
"""Reading a file takes at most this many times the float32 pixels of its largest window or tile."""

SCRATCH = 64 << 20
"""Bytes that reading a file may take beside that."""

_MODEST_BYTES = 1 << 28
_MAX_RATIO = 4096
_LINES = {"NO": 1, "RLE": 1, "ZIPS": 1, "ZIP": 16, "PXR24": 16, "PIZ": 32, "B44": 32, "B44A": 32, "DWAA": 32}
_MAGIC = b"\x76\x2f\x31\x01"
_DEEP = 0x800
_EIGHT_BIT = {
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"GIF8": "GIF",
    b"BM": "BMP",
    b"RIFF": "WebP",
}


@dataclass
class ExrImage:
    """The channels of one file, in its display window.

    Attributes:
        path: The file.
        channels: Full channel name → float32 (H, W), or float16 where half channels were to stay so; 0
            outside the data window. In files of several parts a channel without a layer is prefixed by the
            name of its part.
        precision: Channel name → `half`, `float` or `uint`, as stored.
        outside: Channel name → bool (H, W), True outside the data window; only channels that do not fill it.
        attributes: Header attributes of the first part.
        parts: Names of the parts, empty strings where a part has none.
    """

    path: Path
    channels: dict[str, NDArray[Any]]
    precision: dict[str, str]
    attributes: dict[str, Any]
    parts: list[str]
    outside: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        height, width = next(iter(self.channels.values())).shape
        return height, width


def read_exr(path: str | Path, keep_half: bool = False) -> ExrImage:
    """Read every channel of an EXR file.

    Half and float channels become float32, every part is read, and each data window is composed into the
    display window (cropped where it is larger, 0 where it is smaller).

    Args:
        path: The file.
        keep_half: Half channels stay float16.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: The file cannot be opened.
        ValueError: It is empty, no EXR, truncated, damaged, deep, subsampled, or an 8-bit image format.
    """
    path = Path(path)
    _check_header(path)
    headers = _headers(path)
    expected = len(headers)
    _check_size(path, headers)
    try:
        # The library prints a warning to standard output where it should raise.
        with (
            muted(),
            OpenEXR.File(str(path), separate_channels=True, num_threads=0) as file,
        ):
            parts = [
                (part.name() or "", dict(file.header(i)), _pixels(part, path))
                for i, part in enumerate(file.parts)
            ]
    except (RuntimeError, MemoryError) as error:
        raise _damaged(path, error) from error
    if len(parts) < max(expected, 1) or any(array.size == 0 for _, _, p in parts for array in p.values()):
        raise ValueError(f"{path}: truncated or damaged EXR file: pixels missing; copy or render it again")
    if not any(pixels for _, _, pixels in parts):
        raise ValueError(f"{path}: EXR file without channels")
    return _compose(path, parts, keep_half)


def exr_extent(path: str | Path) -> tuple[int, int, int]:
    """Return rows and columns of a file's largest window or tile, and its channels, without reading pixels.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: The file cannot be opened.
        ValueError: As `read_exr`, as far as the header tells.
    """
    path = Path(path)
    _check_header(path)
    headers = _headers(path)
    _check_size(path, headers)
    if not headers:
        raise ValueError(f"{path}: EXR file without parts")
    sizes = [size for header in headers for size in (_allocated(header), _extent(header["displayWindow"]))]
    count = sum(len(header["channels"]) for header in headers)
    return max(height for _, height in sizes), max(width for width, _ in sizes), count


def exr_channels(path: str | Path) -> list[str]:
    """Return the names of a file's channels without reading pixels; names as `read_exr` gives them.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: The file cannot be opened.
        ValueError: It is empty, no EXR, deep, damaged, or an 8-bit image format.
    """
    path = Path(path)
    _check_header(path)
    names: list[str] = []
    headers = _headers(path)
    for header in headers:
        for channel in header["channels"]:
            names.append(_full_name(channel.name, header.get("name") or "", len(headers) > 1, names))
    return names


def write_exr(
    path: str | Path,
    channels: Mapping[str, NDArray[Any]],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write a ZIP-compressed scan-line EXR file, whole or not at all.

    Args:
        path: Target; its folder is created.
        channels: Channel name → float16 or float32 (H, W); the type chooses half or float. A float16 array
            must hold no value that overflowed.
        attributes: Header attributes: strings, integers, floats.

    Raises:
        ValueError: Another type, or arrays of different size.
        OSError: No permission, full disk …; nothing is left behind.
    """
    path = Path(path)
    if not channels:
        raise ValueError(f"{path}: nothing to write, no channels given")
    shapes = {name: array.shape for name, array in channels.items()}
    if len(set(shapes.values())) > 1 or any(len(s) != 2 for s in shapes.values()):
        raise ValueError(f"{path}: channels must be (H, W) of one size, got {shapes}")
    for name, array in channels.items():
        if array.dtype not in (np.float16, np.float32):
            raise ValueError(f"{path}: channel {name!r} is {array.dtype}, expected float16 or float32")
    header = {
        **(attributes or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        pixels = {name: np.ascontiguousarray(array) for name, array in channels.items()}
        with OpenEXR.File(header, pixels, num_threads=0) as file:
            file.write(str(temporary))
        os.replace(temporary, path)
    except (RuntimeError, OSError) as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = getattr(error, "strerror", None) or str(error)
        raise OSError(f"{path}: cannot write the file: {reason}; check permissions and free space") from error


def _check_header(path: Path) -> None:
    if path.is_dir():
        raise ValueError(f"{path} is a folder, expected an EXR file")
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        raise ValueError(f"{path}: the file is empty")
    for magic, name in _EIGHT_BIT.items():
        if start.startswith(magic):
            raise ValueError(
                f"{path} is a {name} file: 8-bit image, radiance needed; render to OpenEXR (half or float)"
            )
    if start[:4] != _MAGIC:
        raise ValueError(f"{path}: not an OpenEXR file")
    if len(start) < 8:
        raise ValueError(f"{path}: truncated EXR file")
    if int.from_bytes(start[4:8], "little") & _DEEP:
        raise ValueError(f"{path}: deep EXR images are not supported; flatten it first")


def _headers(path: Path) -> list[dict[str, Any]]:
    try:
        with (
            muted(),
            OpenEXR.File(str(path), separate_channels=True, header_only=True) as file,
        ):
            return [dict(file.header(i)) for i in range(len(file.parts))]
    except (RuntimeError, MemoryError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> ValueError:
    reason = str(error) or type(error).__name__
    return ValueError(f"{path}: damaged or truncated EXR file ({reason}); copy or render it again")


def _check_size(path: Path, headers: list[dict[str, Any]]) -> None:
    """Refuse a size that the file cannot hold or memory cannot, before anything is allocated for it."""
    stored = path.stat().st_size
    claimed = placed = chunks = 0
    for header in headers:
        width, height = _allocated(header)
        shown = _extent(header["displayWindow"])
        if min(width, height, *shown) < 1:
            raise ValueError(f"{path}: damaged EXR file: a window of the header is empty; render it again")
        count = len(header["channels"])
        claimed += width * height * count * 4
        placed += shown[0] * shown[1] * count * 4
        if header["type"] == OpenEXR.scanlineimage:
            lines = _LINES.get(str(header["compression"]).split(".")[-1].partition("_")[0], 256)
            chunks += -(-height // lines)
    # Each chunk takes 8 bytes in the table of offsets and at least 8 where it lies.
    implausible = claimed > max(_MODEST_BYTES, _MAX_RATIO * stored) or 16 * chunks > stored
    if implausible or placed > max(4 * _MODEST_BYTES, _MAX_RATIO * stored):
        raise ValueError(
            f"{path}: the header claims {max(claimed, placed) >> 20} MiB of pixels, but the file has only "
            f"{stored} bytes: truncated or damaged EXR file; copy or render it again"
        )
    if max(claimed, placed) > MAX_BYTES:
        raise ValueError(
            f"{path}: {max(claimed, placed) >> 20} MiB of pixels, at most {MAX_BYTES >> 20} MiB are read; "
            "split the image"
        )


def _extent(window: Any) -> tuple[int, int]:
    (left, top), (right, bottom) = (np.asarray(v).tolist() for v in window)
    return right - left + 1, bottom - top + 1


def _allocated(header: Mapping[str, Any]) -> tuple[int, int]:
    """Return the columns and rows that the library makes for a data window: at least those of a tile."""
    width, height = _extent(header["dataWindow"])
    tiles = header.get("tiles")
    if tiles is None or min(width, height) < 1:
        return width, height
    return max(width, int(tiles.xSize)), max(height, int(tiles.ySize))


def _full_name(name: str, part: str, several: bool, taken: Collection[str]) -> str:
    full = f"{part}.{name}" if several and part and "." not in name else name
    return f"{part}.{name}" if full in taken else full


def _pixels(part: Any, path: Path) -> dict[str, NDArray[Any]]:
    pixels = {}
    for name, channel in part.channels.items():
        if channel.xSampling != 1 or channel.ySampling != 1:
            raise ValueError(f"{path}: channel {name!r} is subsampled, expected one value per pixel")
        pixels[name] = np.asarray(channel.pixels)
    return pixels


def _compose(
    path: Path, parts: list[tuple[str, dict[str, Any], dict[str, NDArray[Any]]]], keep_half: bool
) -> ExrImage:
    several = len(parts) > 1
    image = ExrImage(path, {}, {}, _attributes(parts[0][1]), [name for name, _, _ in parts])
    for part, header, channels in parts:
        (left, top), (right, bottom) = (np.asarray(v).tolist() for v in header["displayWindow"])
        size = (bottom - top + 1, right - left + 1)
        for name, array in channels.items():
            full = _full_name(name, part, several, image.channels)
            image.precision[full] = {"float16": "half", "float32": "float"}.get(array.dtype.name, "uint")
            origin = np.asarray(header["dataWindow"][0]) - (left, top)
            if not (keep_half and array.dtype == np.float16):
                array = array.astype(np.float32, copy=False)
            placed, outside = _place(array, int(origin[0]), int(origin[1]), size)
            image.channels[full] = placed
            if outside is not None:
                image.outside[full] = outside
    return image


def _place(
    array: NDArray[Any], x: int, y: int, size: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    height, width = size
    if (x, y) == (0, 0) and array.shape == size:
        return array, None
    placed = np.zeros(size, array.dtype)
    outside = np.ones(size, bool)
    rows = slice(max(y, 0), min(y + array.shape[0], height))
    columns = slice(max(x, 0), min(x + array.shape[1], width))
    if rows.start < rows.stop and columns.start < columns.stop:
        source = (slice(rows.start - y, rows.stop - y), slice(columns.start - x, columns.stop - x))
        placed[rows, columns] = array[source]
        outside[rows, columns] = False
    return placed, outside if outside.any() else None


def _attributes(header: Mapping[str, Any]) -> dict[str, Any]:
    skipped = {"channels", "compression", "type", "lineOrder", "dataWindow", "displayWindow"}
    return {name: value for name, value in header.items() if name not in skipped}
