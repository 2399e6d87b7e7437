"""Cuts a data set into shards and sends them to a URL, so that an interrupted call can be repeated.

Shards are made on this machine first, below `$PENUMBRA_CACHE/outgoing`, or taken from the cache of training
where they are there already. A shard that is at the URL with the right checksum is not sent again. The index
is sent last and, where shards are replaced, removed first, so that a reader never sees half of a set.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from data import remote
from data.frames import FrameSet
from data.progress import size_text
from data.shards.division import plan_shards
from data.shards.estimate import check_room, estimate
from data.shards.folders import UPLOAD, cache_folder
from data.shards.index import INDEX, Index, ShardRecord, write_json
from data.shards.options import PrepareOptions
from data.shards.prepare import Progress, cached_path, identity_of, prepare

TOGETHER = 4
"""Shards that are sent at one time."""
MEGA = 1_000_000
SHARD = re.compile(r"(train|validation|test)-\d+\.tar", re.ASCII)


def publish(
    root: Path,
    url: str,
    options: PrepareOptions,
    *,
    processes: int = 1,
    force: bool = False,
    cutting: Progress | None = None,
    sending: Callable[[], Progress] | None = None,
) -> Index:
    """Cut an ingested data set and send the shards; continues where an earlier call was interrupted.

    Args:
        root: The ingested data set.
        url: Where to.
        options: How.
        processes: Number of processes that cut.
        force: Replace shards that are there already.
        cutting: Called now and then with the samples that are cut and their total.
        sending: Called when sending begins; returns what is told the megabytes that are there, and all.

    Returns:
        The index of the set at the URL.

    Raises:
        ValueError: There is something else at the URL, or shards and no `force`; or the frames cannot be cut.
        OSError: The URL cannot be written, with the reason; or a file cannot be read or written here.
    """
    frames = FrameSet(root)
    plan_shards(frames, options)  # fails before anything is left behind
    identity = identity_of(frames, options)
    _begin(url, identity, force)
    made = cached_path(root, options)
    staging: Path | None = None
    if not (made / INDEX).is_file():
        key = hashlib.sha256(f"{url}\n{json.dumps(identity, sort_keys=True)}".encode()).hexdigest()[:16]
        staging = made = cache_folder() / "outgoing" / f"{root.absolute().name}-{key}"
        staging.parent.mkdir(parents=True, exist_ok=True)
        if not (staging / INDEX).is_file():
            expected = estimate(frames, options)
            check_room(root, staging, expected)
            note = f"shards, about {size_text(expected.bytes)}, are made in {staging.parent} and then sent"
            print(note, file=sys.stderr, flush=True)
    index = prepare(root, made, options, processes=processes, wait_for_others=True, progress=cutting)
    _send_all(index, url, sending() if sending is not None else lambda done, total: None)
    if staging is not None:
        shutil.rmtree(staging)
    return Index.read_remote(url, made)


def _begin(url: str, identity: dict[str, Any], force: bool) -> None:
    """Check what is at the URL, and leave a note there of what is being sent; that tells whether it can be
    written, too."""
    place = remote.shown(url)
    there = remote.listing(url)
    if not force and remote.exists(remote.join(url, INDEX)):
        raise ValueError(f"{place} holds shards already; --force replaces them")
    foreign = [name for name in there or () if name not in (INDEX, UPLOAD) and not SHARD.fullmatch(name)]
    if foreign:
        raise ValueError(f"{place} holds other files ({foreign[0]} …); name a new folder for the shards")
    note = remote.join(url, UPLOAD)
    if not force and remote.exists(note) and _read_note(note) != identity:
        raise ValueError(
            f"{place} holds the beginning of shards from other frames or options; repeat the command that "
            "began them, name another folder, or start over with --force"
        )
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        write_json(Path(folder) / UPLOAD, identity)
        remote.send(Path(folder) / UPLOAD, note)


def _read_note(url: str) -> Any:
    try:
        return json.loads(remote.read_bytes(url, 1 << 20))
    except (ValueError, RecursionError):
        return None


def _send_all(index: Index, url: str, progress: Progress) -> None:
    there = remote.listing(url)
    remote.remove(remote.join(url, INDEX))
    total = sum(shard.bytes for shard in index.shards)
    done = 0
    progress(0, megabytes(total))
    stop = threading.Event()
    with ThreadPoolExecutor(TOGETHER) as pool:
        jobs = {pool.submit(_send, index, shard, url, there, stop): shard for shard in index.shards}
        try:
            for job in as_completed(jobs):
                job.result()
                done += jobs[job].bytes
                progress(done // MEGA if done < total else megabytes(total), megabytes(total))
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    remote.send(index.root / INDEX, remote.join(url, INDEX))
    remote.remove(remote.join(url, UPLOAD))
    named = {shard.file for shard in index.shards}
    for name in there or ():
        if SHARD.fullmatch(name) and name not in named:
            remote.remove(remote.join(url, name))


def _send(
    index: Index, shard: ShardRecord, url: str, there: dict[str, int] | None, stop: threading.Event
) -> None:
    """Send a shard unless it is there with its checksum."""
    target = remote.join(url, shard.file)
    if stop.is_set() or (_may_be_there(shard, there) and _sent(target, shard)):
        return
    remote.send(index.root / shard.file, target)


def _may_be_there(shard: ShardRecord, there: dict[str, int] | None) -> bool:
    return there is None or there.get(shard.file) == shard.bytes


def _sent(url: str, shard: ShardRecord) -> bool:
    try:
        return remote.sha256_of(url, shard.bytes) == shard.sha256
    except FileNotFoundError:
        return False


def megabytes(size: int) -> int:
    """Return bytes in megabytes, rounded up."""
    return -(-size // MEGA)
