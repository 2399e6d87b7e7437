"""What was found out about a still, kept in a folder, so that a run that was cut off goes on.

One JSON file per still holds scores and costs by method, one NPZ file beside it the crops. An entry counts
only while the sources of all networks and filters, the measures, the method's options and the noisy image are
those it was made with.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from data.manifest import file_sha256, write_json
from tests.benchmarks.crops import Crop

SOURCES = ("models", "trainer/metrics", "tests/benchmarks/classical_frames.py", "tests/benchmarks/crops.py")
_ROOT = Path(__file__).parents[2]


class Entry(NamedTuple):
    """One method on one still.

    Attributes:
        scores: Metric → value.
        seconds: Of processor time, of all threads together.
        bytes: By which resident memory grew.
        crop: Where one was wanted.
    """

    scores: dict[str, float]
    seconds: float
    bytes: int
    crop: Crop | None = None


class Kept:
    """Entries of stills in a folder; None keeps nothing."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def load(self, still: str, identities: Mapping[str, str]) -> dict[str, Entry]:
        """Return the entries of a still that are still true.

        Args:
            still: Names it.
            identities: Method → what its result depends on, from `identity`.
        """
        crops = self._crops(still)
        return {
            name: Entry(told["scores"], told["seconds"], told["bytes"], crops.get(name))
            for name, told in self._told(still).items()
            if told["identity"] == identities.get(name)
        }

    def save(self, still: str, entries: Mapping[str, Entry], identities: Mapping[str, str]) -> None:
        """Keep entries of a still beside those of other methods; arguments as of `load`."""
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        crops = self._crops(still)
        crops |= {name: entry.crop for name, entry in entries.items() if entry.crop is not None}
        np.savez(self._path(still, "npz"), **crops)  # type: ignore[arg-type]
        told = self._told(still)
        for name, entry in entries.items():
            told[name] = {"identity": identities[name], **entry._asdict()}
            del told[name]["crop"]
        write_json(self._path(still, "json"), told)

    def _path(self, still: str, suffix: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{still.replace('/', '-').replace(' ', '-')}.{suffix}"

    def _told(self, still: str) -> dict[str, Any]:
        if self.folder is None or not self._path(still, "json").is_file():
            return {}
        told: dict[str, Any] = json.loads(self._path(still, "json").read_text())
        return told

    def _crops(self, still: str) -> dict[str, Crop]:
        if self.folder is None or not self._path(still, "npz").is_file():
            return {}
        try:
            with np.load(self._path(still, "npz"), allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except (OSError, ValueError, zipfile.BadZipFile):  # cut off while it was written
            return {}


def identity(method: str, noisy: Tensor) -> str:
    """Return what a result depends on: the sources, the method (`described`) and the noisy image."""
    image = noisy.contiguous().numpy().tobytes()
    return hashlib.sha256(f"{_sources()} {method} ".encode() + image).hexdigest()[:16]


def described(denoiser: Any, options: Mapping[str, Any]) -> str:
    """Return a method in words that are the same in every run: its class, its options, its checkpoint."""
    told = [f"{denoiser.__module__}.{denoiser.__qualname__}"]
    for name, value in sorted(options.items()):
        told.append(f"{name}={file_sha256(Path(value)) if name == 'model' else value!r}")
    return " ".join(told)


@cache
def _sources() -> str:
    total = hashlib.sha256()
    for place in (_ROOT / name for name in SOURCES):
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            total.update(path.read_bytes())
    return total.hexdigest()
