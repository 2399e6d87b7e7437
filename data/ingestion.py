"""From a layout to a data set: one EXR file per frame and, last of all, the manifest."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from data.buffers import buffer
from data.camera import DepthKind
from data.derive import automatic_exposure, derive
from data.exr import write_frame
from data.frame import Frame
from data.frames import derivable
from data.layouts import closer, layout
from data.layouts.channels import MissingBufferError
from data.layouts.scene import Scene
from data.manifest import (
    MANIFEST,
    FrameRecord,
    Manifest,
    SceneRecord,
    file_sha256,
    load_manifest,
    make_splits,
    write_json,
)
from data.parallel import results

PARTIAL = ".partial"
"""Folder inside the output that remembers finished frames until the manifest is written."""

REMARKS = ("derived", "decoded", "normalised", "clipped", "assumed", "camera", "dropped")
"""Notes of a frame that are kept in its record."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class IngestOptions:
    """What to make of a source.

    Attributes:
        test: Scenes held out for test; empty: the last scene.
        validation: Scenes held out for validation.
        buffers: Buffers to store, None for all that the source has.
        exposure: `layout` for what the layout says (automatic where it says nothing), `auto`, or a number.
        force: Replace a data set that is there, or discard unfinished work on another one.
        processes: Number of processes that read and write frames.
    """

    test: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    buffers: tuple[str, ...] | None = None
    exposure: str = "layout"
    force: bool = False
    processes: int = 1


def ingest(
    name: str,
    root: str | Path,
    output: str | Path,
    options: IngestOptions | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Read a published layout and write frames and manifest.

    An interrupted call goes on where it stopped; the manifest is written last, so that its absence says that
    the set is unfinished.

    Args:
        name: Name of the layout.
        root: Folder of the source.
        output: Folder of the data set.
        options: See `IngestOptions`.
        progress: Called with frames done, frames in all and the label of the last one.

    Raises:
        ValueError: The root has another layout (the message names the likely one), something in it is missing
            or damaged, or the output holds something else.
        OSError: A file cannot be read or written.
    """
    options = options or IngestOptions()
    output = Path(output)
    scenes = _scenes(name, Path(root))
    _check_options(options)
    splits = make_splits([s.name for s in scenes], options.test, options.validation)
    depths = {s.depth for s in scenes}
    _prepare_output(output, name, Path(root), options)
    records = _write_all(scenes, output, options, progress)
    manifest = Manifest(
        name=Path(root).resolve().name,
        layout=name,
        depth=depths.pop(),
        splits=splits,
        scenes={
            s.name: SceneRecord(
                frames=tuple(records[s.name, i] for i in s.indices),
                sequence=s.sequence,
                thresholds=s.thresholds,
                credit=s.credit,
                license=s.license,
                provenance=s.provenance,
            )
            for s in scenes
        },
    )
    _check_sizes(manifest)
    manifest.save(output)
    shutil.rmtree(output / PARTIAL)
    return manifest


def write_record(
    frame: Frame, output: Path, only: Iterable[str] | None = None, depth_kind: DepthKind = "euclidean"
) -> FrameRecord:
    """Write a frame to its place in a data set and return its record.

    `view`, `reference_spp`, `repaired`, `checks` and `remarks` are taken from the frame's notes.

    Raises:
        ValueError: The frame has no exposure, or lacks a named buffer.
        OSError: The file cannot be written.
    """
    if frame.exposure is None:
        raise ValueError(f"{frame.label} has no exposure")
    file = f"{frame.scene}/f{frame.index:03d}.exr"
    names = list(frame.buffers if only is None else only)
    frame.require(*names)
    stored = replace(frame, buffers={n: frame.buffers[n] for n in names}, notes={})
    precision = write_frame(stored, output / file)
    known = derive(stored, derivable(stored), depth_kind=depth_kind)
    told = frame.notes
    return FrameRecord(
        index=frame.index,
        file=file,
        bytes=(output / file).stat().st_size,
        sha256=file_sha256(output / file),
        width=frame.width,
        height=frame.height,
        exposure=frame.exposure,
        spp=frame.spp,
        buffers=precision,
        derived=known.notes["derived"],
        repaired=told.get("repaired", {}),
        view=told.get("view"),
        reference_spp=told.get("reference_spp"),
        samples=[] if frame.samples is None else list(frame.samples.names),
        checks=told.get("checks", {}),
        remarks={key: told[key] for key in REMARKS if told.get(key)},
    )


def _scenes(name: str, root: Path) -> list[Scene]:
    module = layout(name)
    try:
        scenes: list[Scene] = module.describe(root)
    except MissingBufferError:
        raise
    except ValueError as error:
        hint = closer(root, name)
        if not hint:
            raise
        raise ValueError(f"{error}{hint}") from error
    for scene in scenes:
        if scene.name != Path(scene.name).name or scene.name.startswith("."):
            raise ValueError(f"{root}: scene name {scene.name!r} cannot be the name of a folder")
    names = [s.name for s in scenes]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"{root}: two scenes are called {twice[0]!r}")
    if len({s.depth for s in scenes}) > 1:
        raise ValueError(f"{root}: scenes with different kinds of depth; ingest them separately")
    return scenes


def _check_options(options: IngestOptions) -> None:
    for name in options.buffers or ():
        buffer(name)
    if options.exposure in ("layout", "auto"):
        return
    try:
        good = 0 < float(options.exposure) < float("inf")
    except ValueError:
        good = False
    if not good:
        raise ValueError(f"exposure {options.exposure!r}: expected layout, auto or a positive number")


def _prepare_output(output: Path, name: str, root: Path, options: IngestOptions) -> None:
    """Make the output ready: refuse a finished set, continue an unfinished one of the same source."""
    if output.exists() and not output.is_dir():
        raise OSError(f"{output} is a file; --output must name a folder")
    partial_folder = output / PARTIAL
    job = {
        "layout": name,
        "root": str(root.resolve()),
        "buffers": options.buffers and list(options.buffers),
        "exposure": options.exposure,
    }
    if (output / MANIFEST).exists():
        if not options.force:
            raise ValueError(f"{output} already holds a data set; --force replaces it")
        remove_set(output)
    elif partial_folder.is_dir():
        if _job(partial_folder) == job:
            return
        if not options.force:
            raise ValueError(
                f"{output} holds unfinished work of another ingestion; --force discards it, or choose "
                "another --output"
            )
        shutil.rmtree(partial_folder)
    elif output.is_dir() and any(output.iterdir()):
        raise ValueError(f"{output} is not empty and no data set; choose an empty or new folder for --output")
    try:
        partial_folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot write to {output}: {error.strerror}; choose another --output") from error
    write_json(partial_folder / "job.json", job)


def _job(folder: Path) -> Any:
    try:
        return json.loads((folder / "job.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def remove_set(output: Path) -> None:
    """Remove the files that a manifest lists, and nothing else."""
    try:
        files = [f.file for scene in load_manifest(output).scenes.values() for f in scene.frames]
    except ValueError:
        files = []
    (output / MANIFEST).unlink()
    shutil.rmtree(output / PARTIAL, ignore_errors=True)
    for file in files:
        (output / file).unlink(missing_ok=True)
        folder = (output / file).parent
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _write_all(
    scenes: list[Scene], output: Path, options: IngestOptions, progress: Progress | None
) -> dict[tuple[str, int], FrameRecord]:
    frames = [(s.name, i) for s in scenes for i in s.indices]
    work = partial(_one, {s.name: s for s in scenes}, output, options)
    records: dict[tuple[str, int], FrameRecord] = {}
    for key, record in results(work, frames, options.processes):
        records[key] = record
        if progress is not None:
            progress(len(records), len(frames), f"{key[0]}/frame {key[1]}")
    return records


def _one(
    scenes: Mapping[str, Scene], output: Path, options: IngestOptions, key: tuple[str, int]
) -> FrameRecord:
    """Write one frame, unless an earlier call did, and remember it."""
    scene, index = scenes[key[0]], key[1]
    memory = output / PARTIAL / f"{scene.name}-{index:03d}.json"
    known = _remembered(memory, output)
    if known is not None:
        return known
    frame = scene.read(index)
    exposure = frame.exposure if options.exposure == "layout" else None
    if options.exposure not in ("layout", "auto"):
        exposure = float(options.exposure)
    if exposure is None:
        exposure = automatic_exposure(derive(frame, ["color"]).buffers["color"])
    record = write_record(replace(frame, exposure=exposure), output, options.buffers, scene.depth)
    write_json(memory, asdict(record))
    return record


def _remembered(memory: Path, output: Path) -> FrameRecord | None:
    try:
        record = FrameRecord(**json.loads(memory.read_text(encoding="utf-8")))
        path = output / record.file
        whole = path.stat().st_size == record.bytes and file_sha256(path) == record.sha256
    except (OSError, ValueError, TypeError):
        return None
    return record if whole else None


def _check_sizes(manifest: Manifest) -> None:
    for name, scene in manifest.scenes.items():
        sizes = {(f.width, f.height): f.index for f in scene.frames}
        if scene.sequence and len(sizes) > 1:
            listed = ", ".join(f"{w}x{h} (frame {i})" for (w, h), i in sizes.items())
            raise ValueError(f"scene {name!r}: frames of one sequence have different sizes: {listed}")


def default_processes() -> int:
    """Return how many processes to use where nobody says: one per core, at most four."""
    return min(4, len(os.sched_getaffinity(0)))
