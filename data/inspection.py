"""What a file, a data set, a raw layout or shards contain, as plain dictionaries."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

INDEX = "index.json"
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


def _shards(root: Path) -> dict[str, Any]:
    try:
        index = json.loads((root / INDEX).read_text(encoding="utf-8"))
        if not isinstance(index, dict) or index["format"] != "penumbra-shards":
            raise ValueError("its `format` is not penumbra-shards")
        shards = index["shards"]
        found = {s["file"]: _shard_problem(root, s) for s in shards}
        splits = {split: [s for s in shards if s["split"] == split] for split in SPLITS}
        return {
            "kind": "shards",
            "path": str(root),
            "manifest_hash": index["manifest_hash"],
            "options": index["options"],
            "problems": [p for p in found.values() if p],
            "splits": {
                name: {
                    "shards": len(group),
                    "samples": sum(len(s["samples"]) for s in group),
                    "bytes": sum(s["bytes"] for s in group),
                    "buffers": _sampled(root, [s for s in group if not found[s["file"]]]),
                }
                for name, group in splits.items()
            },
        }
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{root / INDEX} is damaged: {error!s}; run `trainer prepare` again") from error


def _shard_problem(root: Path, shard: Mapping[str, Any]) -> str | None:
    path = root / shard["file"]
    if path.parent != root or path.name in ("", ".."):
        return f"{root / INDEX} names {shard['file']!r}, which is no file of its folder; the index is damaged"
    if not path.is_file():
        return f"{path} is missing; run `trainer prepare` again"
    if path.stat().st_size != shard["bytes"] or file_sha256(path) != shard["sha256"]:
        return f"{path} does not match its checksum: altered or truncated; run `trainer prepare` again"
    return None


def _sampled(root: Path, shards: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return statistics over a few samples, evenly spread over whole shards of a split."""
    places = [(s["file"], p) for s in shards for p in s["samples"]]
    chosen = places[:: max(1, -(-len(places) // SAMPLES))]
    found: dict[str, list[dict[str, Any]]] = {}
    for file, place in chosen:
        with (root / file).open("rb") as stream:
            stream.seek(max(place["offset"], 0))
            data = stream.read(min(place["size"], (root / file).stat().st_size))
        for name, values in _sample_statistics(data).items():
            found.setdefault(name, []).append(values)
    return {name: _merge(values) for name, values in found.items()}


def _sample_statistics(data: bytes) -> dict[str, dict[str, Any]]:
    try:
        with tarfile.open(fileobj=io.BytesIO(data)) as tar:
            files = [(m.name, tar.extractfile(m)) for m in tar.getmembers() if m.isfile()]
            members = {Path(name).suffix: file.read() for name, file in files if file is not None}
        meta, raw = json.loads(members[".json"]), members[".buffers"]
    except (tarfile.TarError, KeyError) as error:
        raise ValueError(f"a sample is no pair of .json and .buffers ({error})") from error
    result: dict[str, dict[str, Any]] = {}
    for entry in meta["buffers"]:
        count = int(np.prod(entry["shape"]))
        array = np.frombuffer(raw, entry["dtype"], count, entry["offset"]).reshape(entry["shape"])
        result |= _quantities(entry, array) if entry["name"] == KEPT_APART else {}
        if entry["name"] in BUFFERS:
            image = np.moveaxis(array, 0, -1).astype(np.float32)
            good = np.isfinite(image).all(-1)
            result[entry["name"]] = {
                "type": "half" if array.dtype.itemsize == 2 else "float",
                "shape": list(entry["shape"]),
                **(statistics(entry["name"], image[good][None]) if good.any() else {}),
                "non_finite_percent": 100 * float(1 - good.mean()),
            }
    return result


def _quantities(entry: Mapping[str, Any], array: NDArray[Any]) -> dict[str, dict[str, Any]]:
    """Return type, shape and the share of dropped samples of samples that are kept apart."""
    gone = np.isnan(array).all(1)
    kind = "half" if array.dtype.itemsize == 2 else "float"
    percent = 100 * float(gone.mean())
    return {KEPT_APART: {"type": kind, "shape": list(entry["shape"]), "non_finite_percent": percent}}


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
