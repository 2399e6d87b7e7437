"""What `--data.root` may name: the sample that ships, ingested frames, prepared shards."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from data import remote
from data.manifest import MANIFEST
from data.sample import SAMPLES
from data.shards.folders import UPLOAD, remote_folder
from data.shards.index import INDEX

SAMPLE = "sample:"


@dataclass(frozen=True)
class Root:
    """A data root that can be used.

    Attributes:
        kind: `frames`: ingested, a manifest and EXR files; `shards`: prepared.
        path: The folder; of shards at a URL, that of their copies on this machine.
        url: Where the shards lie, None on this machine.
    """

    kind: Literal["frames", "shards"]
    path: Path
    url: str | None = None


def resolve_root(root: str | Path) -> Root:
    """Return what a data root is.

    Args:
        root: `sample:NAME`, an ingested folder or a prepared folder, `~` is the home folder; or the URL of
            shards.

    Raises:
        ValueError: It is none of these; the message says which command makes it one.
        FileNotFoundError: There is no such folder or sample.
        OSError: A URL cannot be read.
    """
    url = remote.url_of(root)
    if url is not None:
        return _at_url(url)
    if str(root).startswith(SAMPLE):
        return _sample(str(root).removeprefix(SAMPLE))
    path = Path(root).expanduser()
    if (path / INDEX).is_file():
        return Root("shards", path)
    if (path / MANIFEST).is_file():
        return Root("frames", path)
    unfinished = path.with_name(path.name + ".partial")
    if (unfinished / "plan.json").is_file():
        raise ValueError(
            f"{path} is not finished, its preparation was interrupted; continue it with: "
            f"trainer prepare FRAMES --output {path}"
        )
    if not path.is_dir():
        what = "is a file" if path.exists() else "does not exist"
        raise FileNotFoundError(
            f"data root {path} {what}; name a folder made by `trainer ingest` or `trainer prepare`, or "
            f"{' or '.join(SAMPLE + name for name in SAMPLES)}"
        )
    raise ValueError(_advice(path))


def _at_url(url: str) -> Root:
    if remote.exists(remote.join(url, INDEX)):
        return Root("shards", remote_folder(), url)
    place = remote.shown(url)
    if remote.exists(remote.join(url, UPLOAD)):
        raise ValueError(
            f"{place} is not finished, its upload was interrupted; continue it with: trainer prepare FRAMES "
            f"--output {place}"
        )
    if remote.exists(remote.join(url, MANIFEST)):
        raise ValueError(
            f"{place} holds frames; over the network only shards are read. Copy the frames to this machine "
            f"and write shards there: trainer prepare FRAMES --output {place}-shards"
        )
    raise FileNotFoundError(
        f"{place} holds no shards (there is no {INDEX}); check the address, or write shards there: "
        f"trainer prepare FRAMES --output {place}"
    )


def _sample(name: str) -> Root:
    known = list(SAMPLES)
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {SAMPLE}{near[0]}? " if near else ""
        listed = ", ".join(SAMPLE + other for other in known)
        raise FileNotFoundError(f"there is no data set {SAMPLE}{name}; {hint}known: {listed}")
    return Root("frames", SAMPLES[name])


def _advice(path: Path) -> str:
    """Return what a folder without manifest and index seems to be, and the command for it."""
    if next(path.glob("*.tar"), None) is not None:
        return (
            f"{path} holds shards but no {INDEX}, so they are not complete; prepare them anew: "
            f"trainer prepare FRAMES --output {path.with_name(path.name + '-shards')}"
        )
    layout = _layout(path)
    if layout is not None:
        source, name = layout
        return (
            f"{path} is a data set in the layout {name!r} that has to be ingested first: "
            f"trainer ingest --layout {name} {source} --output {path.with_name(path.name + '-frames')}"
        )
    inner = next((p.parent for name in (MANIFEST, INDEX) for p in sorted(path.glob(f"*/{name}"))), None)
    if inner is not None:
        return f"{path} is no data set, but {inner} is; use --data.root {inner}"
    if next(path.glob("*/f[0-9]*.exr"), None) is not None:
        return (
            f"{path} holds frames but no {MANIFEST}, so their ingestion did not finish; run it again: "
            f"trainer ingest --layout LAYOUT SOURCE --output {path}"
        )
    return (
        f"{path} is no data set: it has neither {MANIFEST} (made by `trainer ingest --layout LAYOUT SOURCE "
        f"--output DIR`) nor {INDEX} (made by `trainer prepare DIR --output SHARDS`)"
    )


def _layout(path: Path) -> tuple[Path, str] | None:
    """Return the root and name of the published layout that a folder looks like."""
    if any(path.glob("*/inputs/color*.exr")):
        return path, "bmfr"
    if any(path.glob("inputs/color*.exr")):
        return path.resolve().parent, "bmfr"
    for pattern in ("*/sequence.json", "*/*/sequence.json", "sequence.json"):
        if any(path.glob(pattern)):
            return path if pattern != "sequence.json" else path.resolve().parent, "penumbra"
    return None
