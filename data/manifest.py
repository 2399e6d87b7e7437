"""The manifest of a data set: scenes, frames, checksums, splits, licences, what was derived and repaired."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from data.camera import DepthKind

MANIFEST = "manifest.json"
FORMAT = "penumbra-frames"
VERSION = 1
SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class FrameRecord:
    """One frame on disk.

    Attributes:
        index: Number within its scene.
        file: Path below the data root, with forward slashes.
        bytes: Size of the file.
        sha256: Checksum of the file.
        width: Number of columns.
        height: Number of rows.
        exposure: Factor to a displayable level.
        spp: Samples per pixel of the noisy buffers, None where unknown.
        buffers: Buffer → `half` or `float`, as stored.
        derived: Buffer → rule, for buffers that are not in the file and are computed when it is read.
        repaired: Buffer → number of pixels that were not finite and were replaced.
        view: Number of the view, where a scene has frames of one view with different samples per pixel.
        reference_spp: Samples per pixel of `reference`, None where unknown.
        samples: Quantities that are kept per sample, empty where samples are not kept apart.
        checks: What was measured when the frame was made, such as `energy_z` and `reference_relmse`.
        remarks: What its layout did to stored buffers or took for granted: `derived`, `decoded`,
            `normalised`, `clipped`, `assumed`, `camera`; `dropped`, numbers as in `data.dropped.Dropped`.
    """

    index: int
    file: str
    bytes: int
    sha256: str
    width: int
    height: int
    exposure: float
    spp: int | None = None
    buffers: dict[str, str] = field(default_factory=dict)
    derived: dict[str, str] = field(default_factory=dict)
    repaired: dict[str, int] = field(default_factory=dict)
    view: int | None = None
    reference_spp: int | None = None
    samples: list[str] = field(default_factory=list)
    checks: dict[str, float] = field(default_factory=dict)
    remarks: dict[str, Any] = field(default_factory=dict)

    @property
    def moment(self) -> int:
        """When it is; frames of one view with different samples per pixel are of the same moment."""
        return self.index if self.view is None else self.view


@dataclass(frozen=True)
class SceneRecord:
    """One scene: its frames, and where they came from.

    Attributes:
        frames: In ascending order of index.
        sequence: Consecutive frames of one camera path, so that they may be accumulated.
        thresholds: `position_limit_squared` and `normal_limit_squared` for accumulation; empty: automatic.
        credit: Who made the scene.
        license: Under which terms it may be passed on.
        provenance: Renderer, samples per pixel of the reference, changes.
        origin: Everything needed to make the scene again, where it was made by `trainer render`.
    """

    frames: tuple[FrameRecord, ...]
    sequence: bool = True
    thresholds: dict[str, float] = field(default_factory=dict)
    credit: str = ""
    license: str = ""
    provenance: str = ""
    origin: dict[str, Any] = field(default_factory=dict)

    def strands(self) -> list[tuple[FrameRecord, ...]]:
        """Return the frames in the order in which they may follow one another.

        A camera path whose views have several numbers of samples per pixel is one sequence for each number;
        otherwise there is one list of all.
        """
        views = [frame.view for frame in self.frames]
        if not self.sequence or None in views or len(set(views)) == len(views):
            return [self.frames]
        levels = dict.fromkeys(frame.spp for frame in self.frames)
        return [tuple(frame for frame in self.frames if frame.spp == level) for level in levels]


@dataclass(frozen=True)
class Manifest:
    """Content of a data set.

    Attributes:
        name: Name of the data set.
        layout: The layout that it was ingested from.
        depth: What depth means: `z` or `euclidean`.
        splits: Split → names of scenes; a scene is in one split only, and frames of a scene never divide.
        scenes: Name → record.
        notes: Anything that a reader should know, such as rounding.
        recipe: Everything else needed to make the set again, where it was made by `trainer render`.
    """

    name: str
    layout: str
    depth: DepthKind
    splits: dict[str, list[str]]
    scenes: dict[str, SceneRecord]
    notes: str = ""
    recipe: dict[str, Any] = field(default_factory=dict)

    @property
    def hash(self) -> str:
        """sha256 of the canonical JSON: the same content gives the same hash on every machine."""
        text = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def frame_count(self) -> int:
        """Number of frames in all scenes."""
        return sum(len(scene.frames) for scene in self.scenes.values())

    def split_of(self, scene: str) -> str:
        """Return the split that a scene belongs to.

        Raises:
            ValueError: No split names it.
        """
        for split, names in self.splits.items():
            if scene in names:
                return split
        raise ValueError(f"scene {scene!r} is in no split; scenes: {', '.join(self.scenes)}")

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists; later additions to version 1 only where they say something."""
        values = asdict(self)
        _drop_empty(values, ("recipe",))
        for scene in values["scenes"].values():
            _drop_empty(scene, ("origin",))
            for frame in scene["frames"]:
                _drop_empty(frame, ("view", "reference_spp", "samples", "checks", "remarks"))
        return {"format": FORMAT, "version": VERSION, **values}

    @staticmethod
    def from_json(values: Any, source: str = MANIFEST) -> Manifest:
        """Return the manifest that `to_json` wrote.

        Raises:
            ValueError: Another format or version, a missing or unknown key, or splits that do not fit.
        """
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise ValueError(f"{source} is not a manifest of frames (its `format` is not {FORMAT!r})")
        if values.get("version") != VERSION:
            raise ValueError(
                f"{source} has version {values.get('version')}, this program reads version {VERSION}; "
                "ingest the data again with `trainer ingest`"
            )
        try:
            scenes = {
                name: _record(
                    SceneRecord,
                    {**scene, "frames": tuple(_record(FrameRecord, f) for f in scene["frames"])},
                )
                for name, scene in values["scenes"].items()
            }
            rest = {k: v for k, v in values.items() if k not in ("format", "version", "scenes")}
            manifest: Manifest = _record(Manifest, {**rest, "scenes": scenes})
            manifest.validate(source)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{source} is incomplete or damaged: {error}; run `trainer ingest` again"
            ) from error
        return manifest

    def validate(self, source: str = MANIFEST) -> None:
        """Check splits, depth and frame records.

        Raises:
            ValueError: Names what does not fit.
        """
        if self.depth not in get_args(DepthKind):
            raise ValueError(f"{source}: depth is {self.depth!r}, expected one of {get_args(DepthKind)}")
        unknown = sorted(set(self.splits) - set(SPLITS))
        if unknown:
            raise ValueError(f"{source}: unknown split {unknown[0]!r}, expected {', '.join(SPLITS)}")
        listed = [scene for names in self.splits.values() for scene in names]
        for scene in listed:
            if scene not in self.scenes:
                raise ValueError(
                    f"{source}: a split names {scene!r}, but the scenes are {', '.join(self.scenes)}"
                )
            if listed.count(scene) > 1:
                raise ValueError(f"{source}: scene {scene!r} is listed twice in the splits")
        for scene in self.scenes:
            if scene not in listed:
                raise ValueError(f"{source}: scene {scene!r} is in no split")
        for name, record in self.scenes.items():
            _check_frames(source, name, record)

    def save(self, root: Path) -> None:
        """Write `manifest.json` into a data root, whole or not at all.

        Raises:
            OSError: It cannot be written.
        """
        self.validate()
        write_json(root / MANIFEST, self.to_json())


def load_manifest(root: str | Path) -> Manifest:
    """Read and check the manifest of a data root.

    Raises:
        FileNotFoundError: There is none; the message says what to run.
        ValueError: It is damaged.
    """
    path = Path(root) / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist: {root} is no ingested data set, or its ingestion did not finish; "
            "run `trainer ingest --layout LAYOUT SOURCE --output DIR`"
        )
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}; run `trainer ingest` again") from error
    return Manifest.from_json(values, str(path))


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: Path, values: Any) -> None:
    """Write JSON whole or not at all.

    Raises:
        OSError: It cannot be written; nothing is left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(values, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        if temporary.parent.is_dir():
            temporary.unlink(missing_ok=True)
        reason = error.strerror or str(error)
        raise OSError(f"{path}: cannot write the file: {reason}; check permissions and free space") from error


def make_splits(
    scenes: Iterable[str], test: Iterable[str] = (), validation: Iterable[str] = ()
) -> dict[str, list[str]]:
    """Return the splits: the named test and validation scenes, the others for training.

    Where no test scene is named and there are at least two scenes, the last one is held out, as WSKP holds
    out one of its scenes.

    Raises:
        ValueError: A name is no scene, is in two splits, or no scene would be left for training.
    """
    scenes, test, validation = list(scenes), list(dict.fromkeys(test)), list(dict.fromkeys(validation))
    for name in (*test, *validation):
        if name not in scenes:
            raise ValueError(f"there is no scene {name!r} to hold out; scenes: {', '.join(scenes)}")
    both = set(test) & set(validation)
    if both:
        raise ValueError(f"scene {sorted(both)[0]!r} is named for both test and validation")
    if not test and len(scenes) > 1:
        test = [next(s for s in reversed(scenes) if s not in validation)]
    train = [s for s in scenes if s not in test and s not in validation]
    if not train and len(scenes) > 1:
        raise ValueError("no scene is left for training; hold out fewer")
    return {"train": train, "validation": validation, "test": test}


def _drop_empty(values: dict[str, Any], names: tuple[str, ...]) -> None:
    for name in names:
        if values[name] in (None, [], {}):
            del values[name]


def _record(kind: type[Any], values: dict[str, Any]) -> Any:
    known = {f.name for f in fields(kind)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise TypeError(f"unknown key {unknown[0]!r}")
    return kind(**values)


def _check_frames(source: str, name: str, scene: SceneRecord) -> None:
    indices = [f.index for f in scene.frames]
    if not indices:
        raise ValueError(f"{source}: scene {name!r} has no frames")
    if indices != sorted(set(indices)):
        raise ValueError(f"{source}: frames of {name!r} are not in ascending order: {indices}")
    for frame in scene.frames:
        parts = Path(frame.file).parts
        if ".." in parts or Path(frame.file).is_absolute():
            raise ValueError(f"{source}: file {frame.file!r} lies outside the data set")
        if len(frame.sha256) != 64 or frame.width < 1 or frame.height < 1 or not frame.exposure > 0:
            raise ValueError(f"{source}: the record of {frame.file!r} is damaged; run `trainer ingest` again")
