"""Writes shards: tar files whose bytes depend on nothing but their samples."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import tarfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from data.frame import Image
from data.shards.index import SampleRecord, ShardRecord
from data.shards.planes import Planes, Stored

ALIGNMENT = 64


def describe(arrays: Mapping[str, Stored]) -> tuple[list[dict[str, Any]], int]:
    """Return the description of a sample's arrays, and the bytes that they take.

    Args:
        arrays: Name → float16 or float32, channels before rows and columns.

    Returns:
        A list with name, dtype, shape, offset and size of each; arrays lie one after another, each aligned to
        64 bytes.
    """
    described, offset = [], 0
    for name, array in arrays.items():
        dtype = "<f2" if array.dtype == np.float16 else "<f4"
        size = array.nbytes
        described.append(
            {"name": name, "dtype": dtype, "shape": list(array.shape), "offset": offset, "bytes": size}
        )
        offset += size + -size % ALIGNMENT
    return described, offset


def header(name: str, size: int) -> bytes:
    """Return the header of a tar member, without time, owner or other traces of the machine.

    The name goes into a template, which is several times faster than making each header anew.
    """
    made = bytearray(_template(size))
    made[: len(name)] = name.encode("ascii")
    made[148:156] = b" " * 8  # where the checksum goes, which counts it as blanks
    made[148:156] = b"%06o\0 " % sum(made)
    return bytes(made)


@functools.lru_cache(maxsize=64)
def _template(size: int) -> bytes:
    info = tarfile.TarInfo("")
    info.size = size
    info.mode = 0o644
    return info.tobuf(tarfile.USTAR_FORMAT)


def record_of(key: str, meta: Mapping[str, Any], arrays: Mapping[str, Stored]) -> bytearray:
    """Return a sample as the two members of a tar file, `KEY.json` and `KEY.buffers`.

    Args:
        key: Name of the sample.
        meta: What its JSON says beside the list of buffers.
        arrays: As `describe`.
    """
    described, size = describe(arrays)
    text = json.dumps({**meta, "buffers": described}, sort_keys=True).encode()
    block = tarfile.BLOCKSIZE
    start = 2 * block + len(text) + -len(text) % block
    record = bytearray(start + size + -size % block)
    record[:block] = header(f"{key}.json", len(text))
    record[block : block + len(text)] = text
    record[start - block : start] = header(f"{key}.buffers", size)
    for entry, array in zip(described, arrays.values(), strict=True):
        place = np.frombuffer(record, entry["dtype"], array.size, start + entry["offset"])
        place.reshape(array.shape)[...] = array
    return record


class ShardWriter:
    """Writes one shard under a temporary name; it appears under its own name when `finish` is called.

    Use as a context manager: leaving it without `finish` removes what was written.

    Args:
        path: The shard, `<split>-<number>.tar`.
        split: Its split.
        scene: Scene of its samples.

    Raises:
        OSError: The folder cannot be written or the disk is full; the message names the shard.
    """

    def __init__(self, path: Path, split: str, scene: str) -> None:
        self.path, self.split, self.scene = path, split, scene
        self.temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
        self.samples: list[SampleRecord] = []
        self.skipped = self.pruned = 0
        self.per_sample: tuple[int, tuple[str, ...]] | None = None
        self._hash = hashlib.sha256()
        self._offset = 0
        self._file: IO[bytes] | None = None

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # what it could not write was reported already
                self._file.close()
        self.temporary.unlink(missing_ok=True)

    def add(self, meta: Mapping[str, Any], arrays: Mapping[str, Image]) -> None:
        """Append a sample of whole images; `add_stored` takes them as they are stored.

        Args:
            meta: What its JSON says beside the list of buffers.
            arrays: Name → float32 (H, W, C).

        Raises:
            ValueError: A value is not finite.
        """
        self.add_stored(meta, {name: Planes.of(name, image).cut(None, 0) for name, image in arrays.items()})

    def add_stored(self, meta: Mapping[str, Any], arrays: Mapping[str, Stored]) -> None:
        """Append a sample whose arrays have the type and order of `data.shards.planes`."""
        key = f"{self.path.stem}-{len(self.samples):05d}"
        record = record_of(key, meta, arrays)
        self.samples.append(SampleRecord(key, self._offset, len(record), zlib.crc32(record)))
        self._write(record)

    def finish(self) -> ShardRecord:
        """Close the file, give it its name and return its record; without samples there is no file."""
        if not self.samples:
            return self._record()
        self._write(bytes(2 * tarfile.BLOCKSIZE))
        assert self._file is not None
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.temporary, self.path)
        except OSError as error:
            raise self._failed(error) from error
        return self._record()

    def _record(self) -> ShardRecord:
        return ShardRecord(
            file=self.path.name,
            split=self.split,
            scene=self.scene,
            sha256=self._hash.hexdigest(),
            bytes=self._offset,
            samples=tuple(self.samples),
            skipped=self.skipped,
            pruned=self.pruned,
            per_sample=self.per_sample,
        )

    def _write(self, record: bytes | bytearray) -> None:
        try:
            if self._file is None:
                self._file = self.temporary.open("wb")
            self._file.write(record)
        except OSError as error:
            raise self._failed(error) from error
        self._hash.update(record)
        self._offset += len(record)

    def _failed(self, error: OSError) -> OSError:
        return OSError(
            error.errno,
            f"{error.strerror}; shards that are finished are kept, so the same command continues once there "
            "is room and permission to write",
            str(self.path),
        )
