"""Cuts the frames of a data set into shards: planned beforehand, so that it can stop and go on anywhere.

Which patch or candidate goes into which shard follows from the manifest and the options alone. Scenes are
independent and may be done by several processes; the result does not depend on their number. While it is
being made a result lies in `OUTPUT.partial`: finished shards below `shards/`, a record of each below
`records/`. When all are there, the index is written and the folder gets its name.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from data.frames import FrameSet
from data.jobs import Job, elsewhere
from data.manifest import MANIFEST
from data.shards.cut import CUT_VERSION, make_scene
from data.shards.division import Kind, ShardPlan, different_samples, kind_of, left_out, plan_shards
from data.shards.estimate import announcement, check_room, estimate
from data.shards.folders import cache_folder
from data.shards.index import INDEX, VERSION, Index, ShardRecord, write_json
from data.shards.options import PrepareOptions
from data.shards.processes import in_processes

MANY_FRAMES = 50
"""Above so many frames the cache is filled by several processes, whose start then is worth it."""

MOST_PROCESSES = 8
"""Processes that fill the cache, at most; `trainer prepare` takes any number."""

Progress = Callable[[int, int], None]
"""Called with the number of samples that are done and their total."""


def prepare(
    root: Path,
    output: Path,
    options: PrepareOptions,
    *,
    processes: int = 1,
    force: bool = False,
    wait_for_others: bool = False,
    progress: Progress | None = None,
) -> Index:
    """Cut an ingested data set into shards; continues where an earlier call was interrupted.

    Args:
        root: The ingested data set.
        output: The folder of shards to make.
        options: How.
        processes: Number of processes; each takes whole scenes.
        force: Replace shards that are there already.
        wait_for_others: Where another process makes the same output, wait and take its result instead of
            failing.
        progress: Called now and then.

    Returns:
        The index of the finished folder.

    Raises:
        ValueError: `output` exists, belongs to something else, or is being made with other options; or the
            frames cannot be cut.
        OSError: A file cannot be read or written.
    """
    frames = FrameSet(root)
    output = Path(os.path.abspath(output))
    with _locked(output, wait_for_others):
        if wait_for_others and (output / INDEX).is_file():
            return Index.read(output)
        _check_output(output, force)
        work = output.with_name(output.name + ".partial")
        identity = identity_of(frames, options)
        plans = plan_shards(frames, options)  # fails before anything is left behind
        _open_work(work, identity, force)
        records = _make_all(frames, work, plans, options, processes, progress or (lambda done, total: None))
        _check_samples(records)
        manifest = frames.manifest
        Index(
            work / "shards",
            manifest.hash,
            manifest.to_json(),
            options.to_dict(),
            shards=tuple(record for record in records if record.samples),
            skipped=sum(record.skipped for record in records),
            pruned=sum(record.pruned for record in records),
        ).write()
        _publish(work, output)
        return Index.read(output)


def prepare_cached(root: Path, options: PrepareOptions, progress: Progress | None = None) -> Index:
    """Return shards of an ingested data set from the cache, made now if they are not there.

    They are keyed by manifest, options and the version of cutting. Several processes may call this at the
    same time. Says on standard error how much will be made, and where.

    Raises:
        ValueError: The frames cannot be cut.
        OSError: The disk has no room, or a file cannot be read or written.
    """
    output = cached_path(root, options)
    if (output / INDEX).is_file():
        return Index.read(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    frames = FrameSet(root)
    expected = estimate(frames, options)
    for line in (announcement(root, output, expected), *left_out(frames, options)):
        print(line, file=sys.stderr, flush=True)
    check_room(root, output, expected)
    processes = _cache_processes(sum(len(frames.frames(scene)) for scene in frames.scenes()))
    return prepare(root, output, options, processes=processes, wait_for_others=True, progress=progress)


def _cache_processes(frames: int) -> int:
    if frames <= MANY_FRAMES or multiprocessing.current_process().daemon:  # which may not start others
        return 1
    return min(os.cpu_count() or 1, MOST_PROCESSES)


def identity_of(frames: FrameSet, options: PrepareOptions) -> dict[str, Any]:
    """Return what shards follow from: the same identity gives the same shards."""
    return {
        "version": VERSION,
        "cut_version": CUT_VERSION,
        "manifest_hash": frames.manifest.hash,
        "options": options.to_dict(),
    }


def cached_path(root: Path, options: PrepareOptions) -> Path:
    """Return the cache folder of a data set with these options."""
    manifest = FrameSet(root).manifest
    text = json.dumps([VERSION, CUT_VERSION, manifest.hash, options.to_dict()], sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    return cache_folder() / "shards" / f"{root.absolute().name}-{key}"


def _make_all(
    frames: FrameSet,
    work: Path,
    plans: list[ShardPlan],
    options: PrepareOptions,
    processes: int,
    progress: Progress,
) -> list[ShardRecord]:
    sizes = {plan.file: len(plan.samples) for plan in plans}
    total = sum(sizes.values())
    done = _finished(work, plans)
    missing: dict[str, list[ShardPlan]] = {}
    for plan in plans:
        if plan.file not in done:
            missing.setdefault(plan.scene, []).append(plan)

    def report() -> None:
        names = {path.name.removesuffix(".json") for path in (work / "records").glob("*.tar.json")}
        progress(sum(size for file, size in sizes.items() if file in names), total)

    report()
    jobs = [(str(frames.root), scene, group, options, str(work)) for scene, group in missing.items()]
    if runner := elsewhere():
        seen = (frames.root / MANIFEST, work / "plan.json")
        runner([Job(f"scene {job[1]}", make_scene, job, seen) for job in jobs], lambda job, result: report())
    elif processes > 1 and len(jobs) > 1:
        in_processes(make_scene, jobs, min(processes, len(jobs)), report)
    else:
        for job in jobs:
            make_scene(*job, report=report)
    return [_record(work, plan.file) for plan in plans]


def _check_samples(records: list[ShardRecord]) -> None:
    """Check that all shards keep the same samples apart, which the manifest alone need not tell.

    Raises:
        ValueError: They do not.
    """
    kinds: dict[Kind, str] = {}
    for record in records:
        if record.samples:
            kinds.setdefault(kind_of(record.per_sample), f"{record.scene} ({record.split})")
    if len(kinds) > 1:
        raise ValueError(different_samples(kinds))


def _record(work: Path, file: str) -> ShardRecord:
    return ShardRecord.from_dict(json.loads((work / "records" / f"{file}.json").read_text(encoding="utf-8")))


def _finished(work: Path, plans: list[ShardPlan]) -> set[str]:
    """Return the shards that are complete by their record's checksum; other records are removed."""
    done = set()
    for plan in plans:
        path = work / "records" / f"{plan.file}.json"
        if not path.is_file():
            continue
        record, shard = _record(work, plan.file), work / "shards" / plan.file
        if not record.samples or (shard.is_file() and _sha256(shard) == record.sha256):
            done.add(plan.file)
        else:
            path.unlink()
    return done


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_output(output: Path, force: bool) -> None:
    if not output.exists():
        return
    if not output.is_dir():
        raise ValueError(f"{output} is a file; name a folder for the shards")
    ours = (output / INDEX).is_file()
    if any(output.iterdir()) and not ours:
        raise ValueError(f"{output} holds other files; name a new folder for the shards")
    if ours and not force:
        raise ValueError(f"{output} holds shards already; --force replaces them")


def _open_work(work: Path, identity: dict[str, Any], force: bool) -> None:
    path = work / "plan.json"
    if path.is_file():
        if json.loads(path.read_text(encoding="utf-8")) == identity:
            for left in (work / "shards").glob(".*.partial"):
                left.unlink(missing_ok=True)
            _make_work_folders(work)  # an end between publishing and removing leaves the records alone
            return
        if not force:
            raise ValueError(
                f"{work} holds the beginning of shards from other frames or options; repeat the command that "
                "began them, remove the folder, or start over with --force"
            )
    if work.is_dir():
        shutil.rmtree(work)
    _make_work_folders(work)
    write_json(path, identity)


def _make_work_folders(work: Path) -> None:
    for name in ("shards", "records"):
        (work / name).mkdir(parents=True, exist_ok=True)


def _publish(work: Path, output: Path) -> None:
    old = output.with_name(f".{output.name}.old")
    if output.is_dir():
        if any(output.iterdir()):
            if old.is_dir():  # an earlier call ended while it removed what it had replaced
                shutil.rmtree(old)
            os.replace(output, old)
        else:
            output.rmdir()
    os.replace(work / "shards", output)
    shutil.rmtree(work)
    if old.is_dir():
        shutil.rmtree(old)


@contextlib.contextmanager
def _locked(output: Path, wait_for_others: bool) -> Iterator[None]:
    """Hold `.NAME.lock` beside the output; the system releases it when the process ends in whatever way."""
    path = output.with_name(f".{output.name}.lock")
    while True:
        try:
            file = path.open("w")
        except OSError as error:
            raise OSError(
                error.errno, f"cannot write shards into {output.parent}: {error.strerror}", str(path)
            ) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait_for_others else fcntl.LOCK_NB))
        except BlockingIOError as error:
            file.close()
            raise ValueError(f"another process is preparing {output}; wait until it is done") from error
        # The holder before us may have removed the name, and a third process made a new file of that name.
        if path.exists() and path.stat().st_ino == os.fstat(file.fileno()).st_ino:
            break
        file.close()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()
