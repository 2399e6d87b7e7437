"""Sets of frames on disk: a folder with a manifest and one EXR file per frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from data.buffers import buffer
from data.derive import derive, obtainable, sources
from data.exr import StoredFrame, read_frame, read_stored
from data.frame import Frame
from data.manifest import FrameRecord, Manifest, file_sha256, load_manifest

DERIVED = ("albedo", "irradiance", "color", "depth")
"""What `FrameSet.read` adds where it is absent and can be derived."""


class FrameSet:
    """An ingested data set: `ROOT/manifest.json` and `ROOT/<scene>/f<NNN>.exr`.

    Attributes:
        root: The folder.
        manifest: Its checked manifest.
    """

    def __init__(self, root: str | Path) -> None:
        """Read the manifest.

        Raises:
            FileNotFoundError: There is no manifest; the message says what to run.
            ValueError: It is damaged.
        """
        self.root = Path(root)
        self.manifest: Manifest = load_manifest(self.root)

    def scenes(self, split: str | None = None) -> list[str]:
        """Return the names of the scenes of a split, of all scenes without one."""
        return list(self.manifest.scenes) if split is None else list(self.manifest.splits.get(split, []))

    def frames(self, scene: str) -> list[FrameRecord]:
        """Return the records of a scene's frames in ascending order.

        Raises:
            ValueError: There is no such scene.
        """
        if scene not in self.manifest.scenes:
            raise ValueError(f"{self.root} has no scene {scene!r}; scenes: {', '.join(self.manifest.scenes)}")
        return list(self.manifest.scenes[scene].frames)

    def lacking(self, names: Collection[str]) -> tuple[FrameRecord, list[str]] | None:
        """Return the first frame that neither holds some of these buffers nor lets derive them, and which.

        Only the manifest is looked at; None where every frame has them all.
        """
        seen: set[frozenset[str]] = set()
        for record in (record for scene in self.scenes() for record in self.frames(scene)):
            has = frozenset((*record.buffers, *record.derived))
            if has not in seen and (missing := [name for name in names if not _follows(name, has)]):
                return record, missing
            seen.add(has)
        return None

    def read(
        self, scene: str, index: int, names: Iterable[str] | None = None, *, verify: bool = True
    ) -> Frame:
        """Read one frame and derive what is absent.

        Args:
            scene: Name of the scene.
            index: Number of the frame.
            names: Buffers that must be there, derived where necessary; None: whatever of `DERIVED` can be.
            verify: Compare size and checksum with the manifest before reading.

        Raises:
            OSError: The file is missing; the message says which command repairs the set.
            ValueError: The file was altered, no such frame, or a named buffer cannot be derived.
        """
        record = self._record(scene, index)
        self._check(record, verify)
        frame = self._labelled(read_frame(self.root / record.file), scene, record)
        wanted = derivable(frame) if names is None else list(names)
        return derive(frame, wanted, depth_kind=self.manifest.depth)

    def read_stored(
        self,
        scene: str,
        index: int,
        names: Collection[str],
        computed: Collection[str] = (),
        *,
        samples: bool = True,
    ) -> StoredFrame:
        """Read some buffers of a frame for storing them again, and derive those that are absent.

        Args:
            scene: Name of the scene.
            index: Number of the frame.
            names: Buffers that must be there. What the file holds of them in half precision stays so.
            computed: Buffers that must be there in float32.
            samples: Whether to read samples that are kept apart.

        Returns:
            The frame with `computed` and whatever of `names` is not in `halves`. Pixels lie channel by
            channel.

        Raises:
            OSError: As `read`.
            ValueError: As `read`.
        """
        record = self._record(scene, index)
        self._check(record, True)

        def choose(has: Collection[str]) -> tuple[Collection[str], Collection[str]]:
            passed = [name for name in names if name in has and buffer(name).half]
            return sources([n for n in (*names, *computed) if n not in passed or n in computed], has), passed

        frame, halves = read_stored(self.root / record.file, choose, samples)
        frame = self._labelled(frame, scene, record)
        wanted = [name for name in (*names, *computed) if name not in halves or name in computed]
        try:
            return StoredFrame(derive(frame, wanted, depth_kind=self.manifest.depth), halves)
        except ValueError:
            self.read(scene, index, wanted, verify=False)  # fails too, and lists all buffers of the file
            raise

    def _record(self, scene: str, index: int) -> FrameRecord:
        record = next((f for f in self.frames(scene) if f.index == index), None)
        if record is None:
            known = [f.index for f in self.frames(scene)]
            raise ValueError(f"{self.root}: scene {scene!r} has no frame {index}; it has {known}")
        return record

    def _labelled(self, frame: Frame, scene: str, record: FrameRecord) -> Frame:
        frame = replace(frame, scene=scene, index=record.index, exposure=record.exposure, spp=record.spp)
        frame.notes["sequence"] = self.manifest.scenes[scene].sequence
        if record.view is not None:
            frame.notes["view"] = record.view
        return frame

    def sequence(self, scene: str, names: Iterable[str] | None = None) -> Iterator[Frame]:
        """Read the frames of a scene one after the other; `motion` is derived from the preceding camera.

        Frames of one view with several numbers of samples: all with the same number, then the next.
        """
        wanted = None if names is None else list(names)
        previous: Frame | None = None
        for record in (r for strand in self.manifest.scenes[scene].strands() for r in strand):
            rest = None if wanted is None else [n for n in wanted if n != "motion"]
            frame = self.read(scene, record.index, rest)
            if wanted is not None and "motion" in wanted:
                before = previous if previous is not None and frame.follows(previous) else frame
                frame = derive(frame, ["motion"], previous=before.camera)
            previous = frame
            yield frame

    def check(self) -> list[str]:
        """Return what does not agree with the manifest, one sentence per file; empty: all is well."""
        problems = []
        for scene in self.scenes():
            for record in self.frames(scene):
                try:
                    self._check(record, True)
                except (OSError, ValueError) as error:
                    problems.append(str(error))
        return problems

    def _check(self, record: FrameRecord, verify: bool) -> None:
        path = self.root / record.file
        repair = f"run `trainer ingest --force … --output {self.root}` again, or restore the file"
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing, but the manifest lists it; {repair}")
        if not verify:
            return
        size = path.stat().st_size
        if size != record.bytes:
            raise ValueError(
                f"{path} has {size} bytes, the manifest says {record.bytes}: altered or truncated; {repair}"
            )
        if file_sha256(path) != record.sha256:
            raise ValueError(f"{path} does not match the manifest's checksum: altered; {repair}")


def derivable(frame: Frame) -> list[str]:
    """Return those of `DERIVED` that the frame has or that can be derived from what it has."""
    has = frame.buffers.keys()
    albedo = bool({"albedo", "diffuse_albedo"} & has)
    color = {"color_a", "color_b"} <= has or "color" in has
    found = {
        "albedo": albedo,
        "irradiance": color and albedo,
        "color": color or ("irradiance" in has and albedo),
        "depth": "position" in has and frame.camera is not None,
    }
    return [name for name in DERIVED if name in has or found[name]]


def _follows(name: str, has: Collection[str]) -> bool:
    """Return whether a buffer can be derived from others: whether it is, for a frame of one pixel."""
    pixel = Frame({other: np.ones((1, 1, buffer(other).channels), np.float32) for other in has}, "", 0)
    return name in obtainable(pixel, [name])
