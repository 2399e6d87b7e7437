"""What a file, a data set, a raw layout or shards contain, as plain dictionaries."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np

from data import remote
from data.buffers import BUFFERS, buffer
from data.buffers import SAMPLES as KEPT_APART
from data.dropped import Dropped, total
from data.exr import read_frame
from data.frame import Frame, Image
from data.frames import FrameSet
from data.ingestion import PARTIAL
from data.layouts import LAYOUTS, layout, likeliest
from data.layouts.scene import Scene
from data.manifest import MANIFEST, SPLITS, file_sha256
from data.root import resolve_root
from data.shards.cache import ShardCache
from data.shards.index import INDEX, Index, ShardRecord
from data.shards.read import ShardReader

SAMPLES = 8
"""Samples of each split whose pixels are looked at."""


def inspect_path(path: str | Path) -> dict[str, Any]:
    """Return what was found; `kind` is `file`, `data set`, `layout` or `shards`.

    Raises:
        OSError: There is no such path, or it cannot be read.
        ValueError: It is none of these; the message says what was expected.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if path.is_file():
        if path.name in (MANIFEST, INDEX):
            return inspect_path(path.parent)
        name = likeliest(path)
        if name is not None:
            return _layout(path, name)
        return {"kind": "file", "path": str(path), **describe_frame(read_frame(path))}
    if (path / MANIFEST).is_file():
        return _data_set(path)
    if (path / INDEX).is_file():
        return _shards(path)
    if (path / PARTIAL).is_dir():
        raise ValueError(f"{path} is an unfinished ingestion; run the same `trainer ingest` command again")
    name = likeliest(path)
    if name is None:
        raise ValueError(
            f"{path} is neither an EXR file, an ingested data set ({MANIFEST}), prepared shards ({INDEX}), "
            f"nor a folder in one of the layouts {', '.join(LAYOUTS)}"
        )
    return _layout(path, name)


def describe_frame(frame: Frame) -> dict[str, Any]:
    """Return the content of one frame: numbers, camera, and statistics of each buffer."""
    repaired = frame.notes.get("repaired", {})
    channels, precision = frame.notes.get("channels", {}), frame.notes.get("precision", {})
    pixels = frame.height * frame.width
    return {
        "scene": frame.scene,
        "frame": frame.index,
        "width": frame.width,
        "height": frame.height,
        "spp": frame.spp,
        "exposure": frame.exposure,
        "accumulated": frame.accumulated,
        "camera": None if frame.camera is None else frame.camera.to_json(),
        "buffers": {
            name: {
                "channels": channels.get(name, []),
                "type": precision.get(name, "derived"),
                **statistics(name, image),
                "non_finite_percent": 100 * repaired.get(name, 0) / pixels,
            }
            for name, image in frame.buffers.items()
        },
        "samples": None
        if frame.samples is None
        else {
            "count": frame.samples.count,
            "quantities": list(frame.samples.names),
            "dropped": _dropped([frame.notes.get("dropped")]),
        },
        "ignored": frame.notes.get("ignored", []),
        "derived": frame.notes.get("derived", {}),
    }


def statistics(name: str, image: Image) -> dict[str, Any]:
    """Return minimum, median, maximum, and the percentage of pixels at the buffer's no-hit value.

    Args:
        name: Word of the vocabulary.
        image: Finite values (H, W, C).
    """
    return {
        "min": float(image.min()),
        "median": float(np.median(image)),
        "max": float(image.max()),
        "no_hit_percent": 100 * float((image == buffer(name).no_hit).all(-1).mean()),
    }


def _data_set(root: Path) -> dict[str, Any]:
    frames = FrameSet(root)
    manifest = frames.manifest
    problems = frames.check()
    readable = [(s, r.index) for s in frames.scenes() for r in frames.frames(s)[:1]]
    return {
        "kind": "data set",
        "path": str(root),
        "name": manifest.name,
        "layout": manifest.layout,
        "depth": manifest.depth,
        "hash": manifest.hash,
        "frames": manifest.frame_count,
        "splits": manifest.splits,
        "notes": manifest.notes,
        "problems": problems,
        "scenes": {
            name: {
                "split": manifest.split_of(name),
                "frames": len(scene.frames),
                "sequence": scene.sequence,
                "width": scene.frames[0].width,
                "height": scene.frames[0].height,
                "bytes": sum(f.bytes for f in scene.frames),
                "spp": scene.frames[0].spp,
                "exposure": [min(f.exposure for f in scene.frames), max(f.exposure for f in scene.frames)],
                "repaired": _sum(f.repaired for f in scene.frames),
                "dropped": _dropped(f.remarks.get("dropped") for f in scene.frames),
                "thresholds": scene.thresholds,
                "credit": scene.credit,
                "license": scene.license,
                "provenance": scene.provenance,
            }
            for name, scene in manifest.scenes.items()
        },
        "first_frames": {} if problems else {s: describe_frame(frames.read(s, i)) for s, i in readable},
    }


def _layout(root: Path, name: str) -> dict[str, Any]:
    scenes: list[Scene] = layout(name).describe(root)
    return {
        "kind": "layout",
        "path": str(root),
        "layout": name,
        "depth": scenes[0].depth,
        "frames": sum(len(s.indices) for s in scenes),
        "scenes": {
            s.name: {"frames": len(s.indices), "sequence": s.sequence, "thresholds": s.thresholds}
            for s in scenes
        },
        "first_frames": {s.name: describe_frame(s.read(s.indices[0])) for s in scenes},
    }


def inspect_url(url: str) -> dict[str, Any]:
    """Return what was found of shards at a URL, as `inspect_path` does.

    Sizes are compared; checksums of shards only when training downloads them. Samples that are looked at are
    verified.

    Raises:
        OSError: The URL cannot be read.
        ValueError: It holds no shards, or damaged ones.
    """
    root = resolve_root(url)
    assert root.url is not None
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        index = Index.read_remote(root.url, Path(folder))
        sizes = remote.listing(root.url)
        problems = {shard.file: _remote_problem(index, shard, sizes) for shard in index.shards}
        return {**_described(index, problems), "checked": "sizes"}


def _shards(root: Path) -> dict[str, Any]:
    index = Index.read(root, check_sizes=False)
    problems = {shard.file: _shard_problem(root, shard) for shard in index.shards}
    return {**_described(index, problems), "checked": "checksums"}


def _described(index: Index, problems: Mapping[str, str | None]) -> dict[str, Any]:
    return {
        "kind": "shards",
        "path": index.place,
        "manifest_hash": index.manifest_hash,
        "options": index.options,
        "problems": [p for p in problems.values() if p],
        "splits": {
            name: {
                "shards": len(index.of(name)),
                "samples": index.count(name),
                "frames": 1 if name == "test" else index.frames,
                "bytes": sum(s.bytes for s in index.of(name)),
                "buffers": _sampled(index, name, {file for file, p in problems.items() if p}),
            }
            for name in SPLITS
        },
    }


def _shard_problem(root: Path, shard: ShardRecord) -> str | None:
    path = root / shard.file
    if not path.is_file():
        return f"{path} is missing; run `trainer prepare` again"
    if path.stat().st_size != shard.bytes or file_sha256(path) != shard.sha256:
        return f"{path} does not match its checksum: altered or truncated; run `trainer prepare` again"
    return None


def _remote_problem(index: Index, shard: ShardRecord, sizes: Mapping[str, int] | None) -> str | None:
    assert index.url is not None
    url = remote.join(index.url, shard.file)
    try:
        size = remote.size_of(url) if sizes is None else sizes.get(shard.file, -1)
    except FileNotFoundError:
        size = -1
    if size == -1:
        return f"{remote.shown(url)} is missing; send the shards again: trainer prepare … --force"
    if size not in (None, shard.bytes):
        return f"{remote.shown(url)} has {size} bytes, the index says {shard.bytes}: altered or truncated"
    return None


def _sampled(index: Index, split: str, left_out: Set[str]) -> dict[str, Any]:
    """Return statistics over a few samples, evenly spread over whole shards of a split."""
    cache = None if index.url is None else ShardCache(index, 1 << 50)
    reader = ShardReader(index, split, cache=cache)
    numbers = [n for n in range(len(reader)) if reader.shards[reader.locate(n)[0]].file not in left_out]
    found: dict[str, list[dict[str, Any]]] = {}
    for number in numbers[:: max(1, -(-len(numbers) // SAMPLES))]:
        for name, values in _sample_statistics(reader, number).items():
            found.setdefault(name, []).append(values)
    return {name: _merge(values) for name, values in found.items()}


def _sample_statistics(reader: ShardReader, number: int) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {}
    for name in reader.sample(number).buffers:
        array = reader.array(number, name).numpy()
        entry = {"type": "half" if array.dtype.itemsize == 2 else "float", "shape": list(array.shape)}
        if name == KEPT_APART:
            gone = 100 * float(np.isnan(array).all(1).mean())
            result[name] = {**entry, "non_finite_percent": gone}
        elif name in BUFFERS:
            image = np.moveaxis(array, -3, -1).astype(np.float32)
            good = np.isfinite(image).all(-1)
            result[name] = {
                **entry,
                **(statistics(name, image[good][None]) if good.any() else {}),
                "non_finite_percent": 100 * float(1 - good.mean()),
            }
    return result


def _merge(values: list[dict[str, Any]]) -> dict[str, Any]:
    """Combine statistics of samples; the median is the median of the samples' medians."""
    usable = [v for v in values if "min" in v]
    types = sorted({v["type"] for v in values})
    merged: dict[str, Any] = {"type": "/".join(types), "shape": values[0]["shape"]}
    if usable:
        merged |= {
            "min": min(v["min"] for v in usable),
            "median": float(np.median([v["median"] for v in usable])),
            "max": max(v["max"] for v in usable),
        }
    for key in ("no_hit_percent", "non_finite_percent"):
        merged[key] = float(np.mean([v.get(key, 0.0) for v in values]))
    return merged


def _dropped(notes: Iterable[Sequence[int] | None]) -> dict[str, int]:
    """Return samples that do not count, pixels that they lie in, and pixels without any other."""
    found = total(numbers for numbers in notes if numbers)
    return (found or Dropped(0, 0, 0))._asdict()


def _sum(counts: Any) -> dict[str, int]:
    total: dict[str, int] = {}
    for count in counts:
        for name, number in count.items():
            total[name] = total.get(name, 0) + number
    return total
