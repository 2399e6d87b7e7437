"""HDF5 files of foreign origin: opened for reading only, and checked before a number of them is read.

A data set of such a file can name other files (external links, external storage, virtual data sets), hold
objects instead of numbers, claim sizes that no memory holds, or need filters loaded from elsewhere. All of
this is refused; what remains is read in slices of the first axis.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import h5py

MAX_CHUNK_BYTES = 1 << 28
"""Largest chunk that is decompressed in one piece."""

MAX_ITEM_BYTES = 1 << 31
"""Largest item, one index of the first axis, as stored or as float32."""

MAX_RATIO = 1100
"""Largest plausible ratio of claimed to stored bytes: deflate reaches 1032, lzf less."""

_TRUSTED_CHUNK = 1 << 20
_MAGIC = b"\x89HDF\r\n\x1a\n"
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}


def open_hdf5(path: str | Path) -> h5py.File:
    """Open an HDF5 file for reading; the caller closes it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no HDF5 file, truncated or damaged, or h5py is not installed; the message then says
            how to install it.
        OSError: It cannot be opened.
    """
    path = Path(path)
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{path} is read with h5py, which is not installed: pip install penumbra-denoise[layouts]"
        ) from error
    if path.is_dir():
        raise ValueError(f"{path} is a folder, expected an HDF5 file")
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if start != _MAGIC:
        raise ValueError(f"{path}: {'not an HDF5 file' if start else 'the file is empty'}")
    try:
        return h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise ValueError(f"{path}: damaged or truncated HDF5 file ({error}); copy it again") from error


def dataset(file: h5py.File, name: str, ndim: int, channels: int | Sequence[int] = ()) -> h5py.Dataset:
    """Return a data set of numbers after checking that reading it slice by slice is safe.

    Args:
        file: From `open_hdf5`.
        name: Name at the top level, without a path separator.
        ndim: Number of axes.
        channels: Allowed sizes of the last axis where the layout keeps channels there; empty: any. A layout
            with channels elsewhere compares `.shape` itself.

    Raises:
        ValueError: It is absent, a link, virtual, stored outside the file, no array of numbers, has other
            axes or channels, an absurd size, a filter that is not gzip, lzf, shuffle or fletcher32, or is
            damaged. The message names file and data set.
    """
    where = f"{file.filename}: data set {name!r}"
    try:
        found = _checked(file, where, name)
        _check_shape(found, where, ndim, (channels,) if isinstance(channels, int) else tuple(channels))
        _check_size(found, where)
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{where} is damaged ({_reason(error)}); copy the file again") from error
    return found


def items(source: h5py.Dataset, first: int, last: int | None = None) -> NDArray[np.float32]:
    """Read the items `first` to before `last` of the first axis (one without `last`), as float32.

    The first axis is dropped where `last` is None.

    Raises:
        ValueError: The stored bytes are damaged, or there is no such item.
    """
    where = f"{source.file.filename}: data set {source.name.lstrip('/')!r}"
    end = first + 1 if last is None else last
    if not 0 <= first < end <= source.shape[0]:
        raise ValueError(f"{where} has {source.shape[0]} items, asked for {first} to {end - 1}")
    if (end - first) * math.prod(source.shape[1:]) * 4 > MAX_ITEM_BYTES:
        raise ValueError(f"{where}: {end - first} items at once exceed {MAX_ITEM_BYTES >> 20} MiB")
    try:
        _check_chunks(source, where, first, end)
        values = np.asarray(source[first:end], np.float32)
    except (OSError, RuntimeError, zlib.error) as error:
        raise ValueError(
            f"{where}, items {first} to {end - 1}: damaged ({_reason(error)}); copy the file again"
        ) from error
    return values[0] if last is None else values


def names(file: h5py.File) -> list[str]:
    """Return the names at the top level, for messages; links are not followed."""
    try:
        return sorted(file.keys())
    except RuntimeError as error:
        raise ValueError(f"{file.filename}: damaged HDF5 file ({_reason(error)}); copy it again") from error


def _checked(file: h5py.File, where: str, name: str) -> h5py.Dataset:
    import h5py

    if not name or "/" in name or name in (".", ".."):
        raise ValueError(f"{where}: a name at the top level of the file is expected")
    link = file.get(name, getlink=True)
    if link is None:
        raise ValueError(f"{where} is missing; the file has {', '.join(names(file)) or 'none'}")
    if not isinstance(link, h5py.HardLink):
        kind = "a link to another file" if isinstance(link, h5py.ExternalLink) else "a soft link"
        raise ValueError(f"{where} is {kind}, expected the data themselves; copy them into the file")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{where} is a {type(found).__name__.lower()}, expected a data set")
    # Before anything asks for the shape, which may open the files that a virtual data set is made of.
    if found.is_virtual or found.external:
        kind = "virtual" if found.is_virtual else "stored in another file"
        raise ValueError(f"{where} is {kind}, expected the data themselves; copy them into the file")
    return found


def _check_shape(found: Any, where: str, ndim: int, channels: tuple[int, ...]) -> None:
    if found.dtype.kind not in "fiu" or found.dtype.subdtype is not None:
        raise ValueError(f"{where} holds {found.dtype}, expected numbers (float16, float32, integers)")
    if found.shape is None or len(found.shape) != ndim or 0 in found.shape:
        raise ValueError(f"{where} has the shape {found.shape}, expected {ndim} axes, none of them empty")
    if channels and found.shape[-1] not in channels:
        expected = " or ".join(str(c) for c in channels)
        raise ValueError(f"{where} has {found.shape[-1]} channels on its last axis, expected {expected}")


def _check_size(found: Any, where: str) -> None:
    width = found.dtype.itemsize
    claimed, stored = math.prod(found.shape) * width, found.id.get_storage_size()
    properties = found.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if len(set(filters)) < len(filters) or {1, 32000} <= set(filters):
        raise ValueError(f"{where} is compressed several times over, refused")
    for number in filters:
        if number not in _FILTERS:
            known = ", ".join(_FILTERS.values())
            raise ValueError(f"{where} is compressed with filter {number}; known: {known}")
    item = math.prod(found.shape[1:]) * max(width, 4)
    if item > MAX_ITEM_BYTES:
        raise ValueError(f"{where}: the shape {found.shape} needs {item >> 20} MiB per item, refused")
    chunk = math.prod(found.chunks or (1,)) * width
    if chunk > MAX_CHUNK_BYTES:
        raise ValueError(f"{where}: chunks of {found.chunks} need {chunk >> 20} MiB each, refused")
    compressed = bool({1, 32000} & set(filters))
    if claimed > stored * (MAX_RATIO if compressed else 1):
        raise ValueError(
            f"{where} claims the shape {found.shape}, {claimed} bytes, but holds only {stored}: "
            "unfinished or damaged; copy or build the file again"
        )


def _check_chunks(source: Any, where: str, first: int, end: int) -> None:
    """Refuse a large compressed chunk that holds more than it says, before the library inflates it whole."""
    properties = source.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if 1 not in filters or source.chunks is None:
        return
    declared = math.prod(source.chunks) * source.dtype.itemsize + 64
    whole = tuple(slice(0, length) for length in source.shape[1:])
    for at in source.iter_chunks((slice(first, end), *whole)):
        corner = tuple(s.start // c * c for s, c in zip(at, source.chunks, strict=True))
        info = source.id.get_chunk_info_by_coord(corner)
        if info.byte_offset is None or info.size <= _TRUSTED_CHUNK or info.filter_mask:
            continue
        _, stored = source.id.read_direct_chunk(corner)
        # With a checksum after it the stream ends early; what follows is not inflated.
        if len(zlib.decompressobj().decompress(stored, declared)) >= declared:
            raise ValueError(f"{where}: the chunk at {corner} holds more than {declared - 64} bytes, refused")


def _reason(error: Exception) -> str:
    return str(error).strip("'\"").splitlines()[0] if str(error) else type(error).__name__
