"""The index of a folder of shards: what is in which file, where, and with which checksum.

It is not trusted: names cannot leave the folder, samples lie inside their shard and beside each other. An
index has at most `LARGEST` bytes, and reading it takes at most about thirty times as many as it has.
"""

from __future__ import annotations

import json
import os
import re
import tarfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data import remote
from data.shards.description import text, whole
from data.shards.options import LONGEST_CLIP

FORMAT = "penumbra-shards"
VERSION, CLIP_VERSION = 1, 2
"""Of an index of single frames; of one whose training and validation samples are clips."""

INDEX = "index.json"
SPLITS = ("train", "validation", "test")
LARGEST = 1 << 28
"""Bytes of an index, at most; that is enough for about three million samples."""

LARGEST_SHARD = 1 << 42
BLOCK = tarfile.BLOCKSIZE
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,250}", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True)
class SampleRecord:
    """One sample of a shard: `size` bytes from `offset` on, headers of the tar members included."""

    key: str
    offset: int
    size: int
    crc32: int


@dataclass(frozen=True)
class ShardRecord:
    """One shard: file name, split, the scene that all its samples come from, checksum, size, samples.

    Attributes:
        skipped: Planned patches that were left out because their reference is black.
        pruned: Candidates of importance sampling that were dropped.
        per_sample: Samples per pixel that are kept apart, and their channels; None where they are not.
    """

    file: str
    split: str
    scene: str
    sha256: str
    bytes: int
    samples: tuple[SampleRecord, ...] = field(repr=False)
    skipped: int = 0
    pruned: int = 0
    per_sample: tuple[int, tuple[str, ...]] | None = None

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> ShardRecord:
        """Return the record that `to_dict` wrote.

        Raises:
            ValueError: A value cannot be what it should be.
            KeyError: One is missing.
            TypeError: One has another type, or there are too many.
        """
        file, sha256 = text(record["file"], "file"), text(record["sha256"], "sha256")
        if not _FILE.fullmatch(file):
            raise ValueError(f"{file[:80]!r} is no name of a file in this folder")
        if not _SHA256.fullmatch(sha256):
            raise ValueError(f"the sha256 of {file} is {sha256[:80]!r}")
        if record["split"] not in SPLITS:
            raise ValueError(f"{file} has a split other than {', '.join(SPLITS)}")
        size = whole(record["bytes"], f"bytes of {file}", 0, LARGEST_SHARD)
        kept = record.get("per_sample")
        per_sample = None if kept is None else _per_sample(*kept)
        known = {"file": file, "split": str(record["split"]), "scene": text(record["scene"], "scene")}
        counts = {name: whole(record.get(name, 0), name, 0, 2**48) for name in ("skipped", "pruned")}
        unknown = record.keys() - known.keys() - counts.keys() - {"sha256", "bytes", "samples", "per_sample"}
        if unknown:
            raise TypeError(f"unknown entry {sorted(unknown)[0][:80]!r}")
        return cls(
            **known,
            sha256=sha256,
            bytes=size,
            samples=_samples(file, record["samples"], size),
            per_sample=per_sample,
            skipped=counts["skipped"],
            pruned=counts["pruned"],
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        # `asdict` would copy every number of every sample, which takes as long as cutting a small patch.
        return {**vars(self), "samples": [dict(vars(sample)) for sample in self.samples]}


@dataclass(frozen=True)
class Index:
    """What a folder of shards holds.

    Attributes:
        root: The folder; of shards at a URL, that of their copies on this machine.
        manifest_hash: Hash of the manifest of the frames that the shards were cut from.
        manifest: That manifest.
        options: Options of the preparation.
        shards: All shards, in the order of split and number.
        skipped: Planned patches that were left out because their reference is black.
        pruned: Candidates of importance sampling that were dropped.
        url: Where the shards lie, None on this machine.
    """

    root: Path
    manifest_hash: str
    manifest: dict[str, Any]
    options: dict[str, Any]
    shards: tuple[ShardRecord, ...]
    skipped: int = 0
    pruned: int = 0
    url: str | None = None

    @property
    def place(self) -> str:
        """Folder or URL, for messages."""
        return str(self.root) if self.url is None else remote.shown(self.url)

    @property
    def frames(self) -> int:
        """Consecutive frames of a training or validation sample; test samples are single frames."""
        return int(self.options.get("frames", 1))

    def of(self, split: str) -> tuple[ShardRecord, ...]:
        """Return the shards of a split."""
        return tuple(shard for shard in self.shards if shard.split == split)

    def count(self, split: str) -> int:
        """Return the number of samples of a split."""
        return sum(len(shard.samples) for shard in self.of(split))

    def scenes(self, split: str) -> list[str]:
        """Return the scenes of a split in the order of its shards."""
        return list(dict.fromkeys(shard.scene for shard in self.of(split)))

    def write(self) -> None:
        """Write `index.json`, whole or not at all."""
        record = {
            "format": FORMAT,
            "version": VERSION if self.frames == 1 else CLIP_VERSION,
            "manifest_hash": self.manifest_hash,
            "manifest": self.manifest,
            "options": self.options,
            "skipped": self.skipped,
            "pruned": self.pruned,
            "shards": [shard.to_dict() for shard in self.shards],
        }
        write_json(self.root / INDEX, record)

    @classmethod
    def read(cls, root: Path, check_sizes: bool = True) -> Index:
        """Read and check the index of a folder.

        Args:
            root: The folder.
            check_sizes: Compare the size of each file with the index.

        Raises:
            ValueError: The index is not one of ours or not readable, or a shard is missing or has another
                size than the index says.
            OSError: There is no index, or it cannot be read.
        """
        path = root / INDEX
        size = path.stat().st_size
        if size > LARGEST:
            raise ValueError(f"{path} has {size} bytes, an index has at most {LARGEST}")
        index = cls.parse(path.read_bytes(), root, str(path))
        if check_sizes:
            index._check_sizes()
        return index

    @classmethod
    def read_remote(cls, url: str, root: Path) -> Index:
        """Read and check the index of shards at a URL, whose copies will lie in `root`.

        Raises:
            ValueError: As `read`.
            OSError: As `data.remote.fetch`.
        """
        source = remote.join(url, INDEX)
        return cls.parse(remote.read_bytes(source, LARGEST), root, remote.shown(source), url)

    @classmethod
    def parse(cls, data: bytes, root: Path, source: str, url: str | None = None) -> Index:
        """Return the index that these bytes are.

        Args:
            data: Content of `index.json`.
            root: As the attribute.
            source: Where it came from, for messages.
            url: As the attribute.

        Raises:
            ValueError: It is none that this version reads.
        """
        try:
            record = json.loads(data)
            if record["format"] != FORMAT or record["version"] not in (VERSION, CLIP_VERSION):
                raise ValueError(f"format {record['format']!r:.80}, version {record['version']!r:.80}")
            shards = tuple(ShardRecord.from_dict(shard) for shard in record["shards"])
            if len({shard.file for shard in shards}) < len(shards):
                raise ValueError("it names a file twice")
            if not all(shard.samples for shard in shards):
                raise ValueError("it names a file without samples")
            if not isinstance(record["manifest"], dict) or not isinstance(record["options"], dict):
                raise TypeError("manifest and options are no tables")
            _check_frames(record["options"].get("frames", 1), record["version"])
            return cls(
                root,
                text(record["manifest_hash"], "manifest_hash"),
                record["manifest"],
                record["options"],
                shards,
                whole(record["skipped"], "skipped", 0, 2**48),
                whole(record.get("pruned", 0), "pruned", 0, 2**48),
                url,
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            known = f"{FORMAT} version {VERSION} or {CLIP_VERSION}"
            raise ValueError(
                f"{source} is not an index of shards that this version reads ({known}): {error}; prepare the "
                "shards again with: trainer prepare FRAMES --output SHARDS"
            ) from error

    def _check_sizes(self) -> None:
        for shard in self.shards:
            path = self.root / shard.file
            size = path.stat().st_size if path.is_file() else None
            if size != shard.bytes:
                found = "is missing" if size is None else f"has {size} bytes"
                raise ValueError(
                    f"{path} {found}, {self.root / INDEX} says {shard.bytes}: the copy is not complete; "
                    "copy the shard again, or prepare anew: trainer prepare FRAMES --output "
                    f"{self.root} --force"
                )


def _check_frames(frames: Any, version: int) -> None:
    if (whole(frames, "frames", 1, LONGEST_CLIP) > 1) != (version == CLIP_VERSION):
        raise ValueError(f"version {version} does not have samples of {frames} frames")


def _samples(file: str, records: Any, end: int) -> tuple[SampleRecord, ...]:
    """Return the samples of a shard of `end` bytes, which lie one after another."""
    samples = []
    free = 0
    for record in records:
        sample = SampleRecord(**record)
        text(sample.key, "key", 1000)
        offset = whole(sample.offset, f"offset of {sample.key} in {file}", free, end)
        if offset % BLOCK:
            raise ValueError(f"{sample.key} in {file} begins at byte {offset}, no multiple of {BLOCK}")
        free = offset + whole(sample.size, f"size of {sample.key} in {file}", 2 * BLOCK, end - offset)
        whole(sample.crc32, f"crc32 of {sample.key} in {file}", 0, 2**32 - 1)
        samples.append(sample)
    return tuple(samples)


def _per_sample(count: Any, channels: Any) -> tuple[int, tuple[str, ...]]:
    return whole(count, "per_sample", 1, 2**20), tuple(text(name, "per_sample") for name in channels)


def write_json(path: Path, record: Any) -> None:
    """Write a JSON file under a temporary name and rename it, so that it is there whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(_text(record))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _text(record: Any) -> str:
    """Return JSON with a line for each entry, and for each element of an entry that is a list.

    Indenting all of it would take the encoder of the standard library a tenth of the time of cutting.
    """

    def line(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False, sort_keys=True)

    def entry(value: Any) -> str:
        return "[\n" + ",\n".join(map(line, value)) + "\n]" if isinstance(value, list) else line(value)

    if not isinstance(record, dict):
        return line(record) + "\n"
    return "{\n" + ",\n".join(f"{line(key)}: {entry(record[key])}" for key in sorted(record)) + "\n}\n"
