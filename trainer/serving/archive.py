"""ZIP files of a sequence: every name, size and ratio is looked at before anything is unpacked.

This runs where memory is limited (`reader`), since a directory of millions of names costs memory as well.
"""

from __future__ import annotations

import errno
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from trainer.serving.limits import Limits

MAX_RATIO = 1000
"""Largest compression ratio of a member: flat images in EXR files that were written without compression
reach some hundreds."""

_CHUNK = 1 << 20
_ENCRYPTED = 0x1
_BESIDE = ("__MACOSX", ".DS_Store")


def is_zip(path: Path) -> bool:
    """Return whether a file begins as ZIP files do."""
    with path.open("rb") as file:
        return file.read(2) == b"PK"


def unpacked_size(path: Path, limits: Limits) -> int:
    """Return the bytes that `unpack` will write, at most; raises as it does."""
    with _opened(path) as archive:
        members, _ = _members(archive, limits)
    return sum(info.file_size for info in members)


def unpack(path: Path, folder: Path, limits: Limits) -> list[str]:
    """Unpack the EXR files of a ZIP file into a folder, without the folders in it, and return their names.

    Raises:
        ValueError: It is damaged or encrypted, too large or too many, or holds what is no EXR file by name;
            nothing was written where the directory already tells.
    """
    with _opened(path) as archive:
        members, names = _members(archive, limits)
        for info, name in zip(members, names, strict=True):
            _extract(archive, info, folder / name)
    return names


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a ZIP file; what `zipfile` raises for a damaged one becomes a ValueError."""
    damaged = (
        zipfile.BadZipFile,  # records that contradict each other, a wrong checksum
        zlib.error,  # packed bytes that are none
        EOFError,  # packed bytes that end too early
        NotImplementedError,  # a version or a way of packing that is not known, patches
        struct.error,  # a local header that is cut off
        UnicodeDecodeError,  # a name that is no UTF-8, though it claims to be
    )
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except damaged as error:
        raise ValueError(f"{path.name}: damaged or unusual ZIP file ({error}); pack it again") from None
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        raise ValueError(
            f"{path.name}: damaged ZIP file (a place before its start or after its end)"
        ) from None


def _members(archive: zipfile.ZipFile, limits: Limits) -> tuple[list[zipfile.ZipInfo], list[str]]:
    """Return the members that are unpacked, and under which names."""
    members = [info for info in archive.infolist() if not _passed_over(info)]
    return members, _checked(members, limits)


def _passed_over(info: zipfile.ZipInfo) -> bool:
    """Tell folders, and what some systems add to every archive."""
    parts = PurePosixPath(info.filename).parts
    return info.filename.endswith("/") or (bool(parts) and (parts[0] in _BESIDE or parts[-1] in _BESIDE))


def _checked(members: list[zipfile.ZipInfo], limits: Limits) -> list[str]:
    if not members:
        raise ValueError("the ZIP file holds no files; expected the EXR files of a sequence")
    if len(members) > limits.frames:
        raise ValueError(f"the ZIP file holds {len(members)} files, at most {limits.frames} are taken")
    total = sum(info.file_size for info in members)
    if total > limits.unpacked:
        raise ValueError(
            f"the ZIP file unpacks to {total / 1e6:.0f} MB, at most {limits.unpacked / 1e6:.0f} MB are taken"
        )
    names = [_name(info) for info in members]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(
            f"the ZIP file holds {min(twice)!r} twice; expected one sequence with names of its own"
        )
    return names


def _name(info: zipfile.ZipInfo) -> str:
    """Return the name under which a member is unpacked."""
    shown = ascii(info.filename[:80])
    path = PurePosixPath(info.filename.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in info.filename:
        raise ValueError(f"the ZIP file holds {shown}, which leads out of its folder; expected plain names")
    if info.flag_bits & _ENCRYPTED:
        raise ValueError(f"{shown} in the ZIP file is encrypted; expected files that anyone can read")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{shown} in the ZIP file is packed in an unusual way; expected stored or deflated")
    mode = info.external_attr >> 16
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise ValueError(f"{shown} in the ZIP file is no plain file; expected EXR files")
    if path.suffix.lower() != ".exr":
        raise ValueError(f"the ZIP file holds {shown}; expected nothing but EXR files, named *.exr")
    if info.file_size > MAX_RATIO * max(info.compress_size, 1):
        raise ValueError(f"{shown} in the ZIP file unpacks to more than {MAX_RATIO} times its size")
    return plain_name(path.name)


def plain_name(name: str) -> str:
    """Return a name as an EXR file can have it anywhere: letters, digits, `.`, `_` and `-`."""
    stem = name.rpartition(".")[0] or name
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "_" for c in stem)
    return f"{kept.lstrip('.')[-90:] or 'frame'}.exr"


def _extract(archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path) -> None:
    """Write a member, though no more than the directory says that it has."""
    size = 0
    with archive.open(info) as source, target.open("xb") as sink:
        while chunk := source.read(_CHUNK):
            size += len(chunk)
            if size > info.file_size:
                raise ValueError(f"{target.name} in the ZIP file is larger than its directory says")
            sink.write(chunk)
