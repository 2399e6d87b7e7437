"""The index of a folder of shards: what is in which file, where, and with which checksum."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FORMAT = "penumbra-shards"
VERSION = 1
INDEX = "index.json"
SPLITS = ("train", "validation", "test")


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
        """Return the record that `to_dict` wrote."""
        samples = tuple(SampleRecord(**sample) for sample in record["samples"])
        kept = record.get("per_sample")
        per_sample = None if kept is None else (int(kept[0]), tuple(kept[1]))
        return cls(**{**record, "samples": samples, "per_sample": per_sample})

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        # `asdict` would copy every number of every sample, which takes as long as cutting a small patch.
        return {**vars(self), "samples": [dict(vars(sample)) for sample in self.samples]}


@dataclass(frozen=True)
class Index:
    """What a folder of shards holds.

    Attributes:
        root: The folder.
        manifest_hash: Hash of the manifest of the frames that the shards were cut from.
        manifest: That manifest.
        options: Options of the preparation.
        shards: All shards, in the order of split and number.
        skipped: Planned patches that were left out because their reference is black.
        pruned: Candidates of importance sampling that were dropped.
    """

    root: Path
    manifest_hash: str
    manifest: dict[str, Any]
    options: dict[str, Any]
    shards: tuple[ShardRecord, ...]
    skipped: int = 0
    pruned: int = 0

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
            "version": VERSION,
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
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if record["format"] != FORMAT or record["version"] != VERSION:
                raise ValueError(f"format {record['format']!r}, version {record['version']!r}")
            shards = tuple(ShardRecord.from_dict(shard) for shard in record["shards"])
            index = cls(
                root,
                record["manifest_hash"],
                record["manifest"],
                record["options"],
                shards,
                record["skipped"],
                record.get("pruned", 0),
            )
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path} is not an index of shards that this version reads ({FORMAT} version {VERSION}): "
                f"{error}; prepare the shards again with: trainer prepare FRAMES --output SHARDS"
            ) from error
        if check_sizes:
            index._check_sizes()
        return index

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
