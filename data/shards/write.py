"""Writes shards: tar files whose bytes depend on nothing but their samples."""

from __future__ import annotations

import contextlib
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

from data.buffers import buffer
from data.frame import Image
from data.shards.index import SampleRecord, ShardRecord

HALF_MAX = 65504.0
HALF_FLOOR = 2.0**-8
"""Arrays that are not zero but nowhere exceed this are kept in float32: half precision would have fewer than
its 11 bits for values 1/64 of the largest and smaller."""

ALIGNMENT = 64


def half_fits(name: str, array: Image) -> bool:
    """Return whether an array of the named buffer is stored in half precision.

    It is if the vocabulary allows it, its largest magnitude is at most 65504, and not so small that the array
    would lie among the subnormal numbers.
    """
    if not buffer(name).half:
        return False
    largest = float(np.abs(array).max(initial=0.0))
    return largest == 0.0 or HALF_FLOOR <= largest <= HALF_MAX


def encode(arrays: Mapping[str, Image]) -> tuple[list[dict[str, Any]], bytes]:
    """Return the description and the bytes of a sample's buffers.

    Args:
        arrays: Name → float32 (H, W, C).

    Returns:
        A list with name, dtype, shape (C, H, W), offset and size of each, and the concatenated little-endian
        arrays, each aligned to 64 bytes.

    Raises:
        ValueError: A value is not finite; names the buffer.
    """
    described, parts, offset = [], [], 0
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(
                f"buffer {name!r} has values that are not finite; ingest repairs them: trainer ingest"
            )
        dtype = "<f2" if half_fits(name, array) else "<f4"
        payload = np.ascontiguousarray(array.transpose(2, 0, 1).astype(dtype)).tobytes()
        shape = [array.shape[2], array.shape[0], array.shape[1]]
        described.append(
            {"name": name, "dtype": dtype, "shape": shape, "offset": offset, "bytes": len(payload)}
        )
        padding = -len(payload) % ALIGNMENT
        parts += [payload, bytes(padding)]
        offset += len(payload) + padding
    return described, b"".join(parts)


def member(name: str, payload: bytes) -> bytes:
    """Return a tar member: header without time, owner or other traces of the machine, payload, padding."""
    info = tarfile.TarInfo(name)
    info.size = len(payload)
    info.mode = 0o644
    header = info.tobuf(tarfile.USTAR_FORMAT)
    return header + payload + bytes(-len(payload) % tarfile.BLOCKSIZE)


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
        self.skipped = 0
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
        """Append a sample; `meta` is what its JSON says beside the list of buffers.

        Raises:
            ValueError: A value is not finite.
        """
        described, payload = encode(arrays)
        key = f"{self.path.stem}-{len(self.samples):05d}"
        text = json.dumps({**meta, "buffers": described}, sort_keys=True).encode()
        record = member(f"{key}.json", text) + member(f"{key}.buffers", payload)
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
        )

    def _write(self, record: bytes) -> None:
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
