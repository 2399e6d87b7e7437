"""A run in a shared folder or an object store: sent while it trains, fetched where it goes on.

    STORAGE/<experiment>/<run name>/              the run: checkpoints/, run.json, config.yaml, spool/ …
    STORAGE/<experiment>/<run name>/mirror.json   names of what is there
    STORAGE/launches/<launch>.json                which run a launch trains, so that a restart finds it

Every file is sent whole or not at all, and the newest wins. Of one moment, files are copied in the order

    checkpoints, how far the tracking store has the journal, the journal, the files that it names

and sent in the order: run and launch, files, their list, journal, how far the store has it, checkpoints. So
the mirror, whenever its sender dies, has a journal that knows all steps of its checkpoint and all that the
store has, and every file that the journal names.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from data.remote import exists, fetch, is_url, join, read_bytes, send
from data.shards.prepare import cache_folder
from trainer import runs
from trainer.cluster.restoring import CHECKPOINTS, NOTHING, kept_files, reached, whole_last
from trainer.spool.journal import SPOOL

LIST = "mirror.json"
LIST_LIMIT = 16 << 20
"""Bytes of a list of files, at most."""

FIRST = (runs.RUN_FILE, runs.LAUNCH_FILE)
LAST = "checkpoints/last.ckpt"
JOURNAL = f"{SPOOL}/journal.jsonl"
SENT = f"{SPOOL}/sent.json"


def storage_url(storage: str) -> str:
    """Return the URL of a storage; a folder of this machine becomes an absolute one."""
    return storage.rstrip("/") if is_url(storage) else Path(storage).absolute().as_uri()


def run_url(folder: Path, storage: str) -> str:
    """Return where a run is mirrored."""
    return join(join(storage, folder.parent.name), folder.name)


def send_run(folder: Path, storage: str, sent: dict[str, tuple[int, int]], everything: bool = True) -> None:
    """Send the files of a run that have changed.

    Args:
        folder: The run.
        storage: URL of the storage.
        sent: Size and time of what was sent before, by name; is brought up to date.
        everything: Journals and configurations too where there is no new checkpoint.

    Raises:
        OSError: The storage cannot be written.
    """
    place, scratch = run_url(folder, storage), folder / ".mirror"
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        held = _hold_changed(folder, scratch, sent, everything)
        for name in sorted(held, key=_rank):
            if name == JOURNAL:
                _send_json(join(place, LIST), {"files": sorted(sent)})
            send(scratch / name, join(place, name))
            sent[name] = held[name]
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if held:
        _send_json(join(place, LIST), {"files": sorted(sent)})
        launch = runs.noted_launch(folder)
        if launch:
            run = {"experiment": folder.parent.name, "name": folder.name, "finished": launch.get("finished")}
            _send_json(_launch_url(storage, str(launch.get("launch"))), run)


def _rank(name: str) -> tuple[int, str]:
    """Return the place of a file in the order in which a run is sent."""
    late = (JOURNAL, SENT, LAST)
    if name in late:
        return (2, 3, 5)[late.index(name)], name
    return 4 if name.endswith(".ckpt") else int(name not in FIRST), name


def _hold_changed(
    folder: Path, scratch: Path, sent: dict[str, tuple[int, int]], everything: bool
) -> dict[str, tuple[int, int]]:
    """Copy the changed files of a run as they are at one moment; returns size and time of each."""
    held: dict[str, tuple[int, int]] = {}

    def hold(names: Iterable[str]) -> None:
        for name in names:
            with contextlib.suppress(FileNotFoundError):  # replaced or removed this moment
                now = (folder / name).stat()
                if sent.get(name) != (now.st_size, now.st_mtime_ns):
                    held[name] = _hold(folder / name, scratch / name)

    if not (folder / runs.RUN_FILE).is_file():
        return held
    hold(kept_files(folder, CHECKPOINTS))
    if not held and not everything:
        return held
    rest = [name for name in kept_files(folder) if not name.endswith(".ckpt")]
    hold(sorted(rest, key=JOURNAL.__eq__))  # last
    hold(name for name in kept_files(folder, (f"{SPOOL}/files/**/*",)) if name not in held)
    return held


def fetch_run(storage: str, launch: str, root: Path, newer_than: tuple[int, int] = NOTHING) -> Path | None:
    """Bring the run of a launch from a storage to this machine.

    Args:
        storage: Folder or URL.
        launch: Identity of the launch.
        root: Folder of all runs.
        newer_than: What this machine's run has `reached`; only one that is further replaces it.

    Returns:
        The run's folder; None where the storage has no such run, a finished one, or none that is further.

    Raises:
        OSError: The storage cannot be read.
        ValueError: What it holds is damaged.
    """
    storage = storage_url(storage)
    pointer = _launch_url(storage, launch)
    if not exists(pointer):
        return None
    run = _read_json(pointer)
    experiment, name = str(run.get("experiment")), str(run.get("name"))
    if run.get("finished") or not _plain(experiment) or not _plain(name):
        return None
    folder = root / experiment / name
    if not bring_run(run_url(folder, storage), folder, newer_than):
        return None
    print(f"restarted: the run {name} was fetched from {storage}", file=sys.stderr, flush=True)
    return folder


def is_finished(storage: str, launch: str) -> bool:
    """Return whether a storage has the run of a launch, to its end.

    Raises:
        OSError: The storage cannot be read.
        ValueError: What it holds is damaged.
    """
    pointer = _launch_url(storage_url(storage), launch)
    return exists(pointer) and bool(_read_json(pointer).get("finished"))


def bring_run(place: str, folder: Path, newer_than: tuple[int, int] = NOTHING) -> bool:
    """Bring a mirrored run into a folder; returns whether it has `reached` more than what is given.

    Raises:
        OSError: The storage cannot be read.
        ValueError: What it holds is damaged.
    """
    names = [str(entry) for entry in _read_json(join(place, LIST)).get("files", [])]
    if not all(_plain(part) for entry in names for part in entry.split("/")):
        raise ValueError(f"{join(place, LIST)} names files outside of the run")
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Beside the experiment: what a kill leaves of it is not taken for a run.
    scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent.parent))
    try:
        for entry in names:
            (scratch / entry).parent.mkdir(parents=True, exist_ok=True)
            fetch(join(place, entry), scratch / entry)
        if reached(scratch) <= newer_than:
            return False
        for entry in whole_last(names):
            (folder / entry).parent.mkdir(parents=True, exist_ok=True)
            os.replace(scratch / entry, folder / entry)
    finally:
        shutil.rmtree(scratch)
    return True


def fetch_checkpoint(url: str, root: Path) -> Path:
    """Bring a checkpoint to this machine; its run too, where it lies in a mirrored one.

    A run that this machine has, as far or further, is left as it is.

    Args:
        url: Of the checkpoint, or of the mirrored run.
        root: Folder of all runs.

    Raises:
        OSError: It cannot be read.
        ValueError: It is damaged.
    """
    url = url.rstrip("/")
    place, name = (url, LAST) if not url.endswith(".ckpt") else _split(url)
    if place and exists(join(place, LIST)):
        experiment, run = place.split("/")[-2:]
        folder = root / experiment / run
        if _plain(experiment) and _plain(run):
            bring_run(place, folder, reached(folder if folder.is_dir() else None))
            return folder / name
    key = hashlib.sha256(url.encode()).hexdigest()[:16]
    path = cache_folder() / "checkpoints" / key / name.rpartition("/")[2]
    path.parent.mkdir(parents=True, exist_ok=True)
    fetch(url, path)
    return path


def _split(url: str) -> tuple[str, str]:
    """Return the run that a checkpoint lies in, empty where it lies elsewhere, and its name there."""
    place, _, file = url.rpartition("/")
    run, _, parent = place.rpartition("/")
    return (run, f"checkpoints/{file}") if parent == "checkpoints" else ("", file)


def _hold(path: Path, held: Path) -> tuple[int, int]:
    """Copy a file as it is now, for nothing where its kind is replaced and not appended to.

    Returns:
        Size and time of what was held.
    """
    held.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".jsonl":
        with contextlib.suppress(OSError):  # a file system without links
            os.link(path, held)
    if not held.exists():
        shutil.copy2(path, held)
    state = held.stat()
    return state.st_size, state.st_mtime_ns


def _launch_url(storage: str, launch: str) -> str:
    return join(join(storage, "launches"), re.sub(r"[^\w.-]", "-", launch) + ".json")


def _plain(part: str) -> bool:
    return bool(re.fullmatch(r"[\w.@+ -]+", part)) and part not in (".", "..")


def _send_json(url: str, record: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory(prefix="penumbra-mirror-") as scratch:
        path = Path(scratch) / "record.json"
        path.write_text(json.dumps(record, indent=1) + "\n")
        send(path, url)


def _read_json(url: str) -> dict[str, Any]:
    try:
        record = json.loads(read_bytes(url, LIST_LIMIT))
    except json.JSONDecodeError as error:
        raise ValueError(f"{url} is damaged: {error}") from None
    if not isinstance(record, dict):
        raise ValueError(f"{url} is damaged: expected an object")
    return record
