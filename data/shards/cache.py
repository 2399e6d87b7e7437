"""Copies of shards that lie at a URL, on this machine, up to a bound, for all processes of this machine.

    $PENUMBRA_CACHE/remote/SHA256.tar              a shard, whole and verified, under its checksum
    $PENUMBRA_CACHE/remote/.SHA256.BYTES.partial   one that is being downloaded, and the room it will take

Who downloads a shard holds an exclusive lock of its partial file, so no other process does it too; the system
releases it however that process ends. Who reads a shard holds a shared lock as long as it is mapped, and only
shards that nobody holds are removed, the longest unused first. (On Linux a file that is removed anyway,
by hand, stays readable for those who have it mapped.) Files get their names when they are complete.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from data import remote
from data.shards.index import Index, ShardRecord

POLL_S = 0.05
LOOK_AGAIN_S = 1.0
"""Seconds after which a cache without room is looked at again: a look at some thousand files takes 30 ms."""
FREE = 64 << 20
"""Bytes of the disk that are left free."""


class ShardCache:
    """The copies of the shards of one index; others' shards in the same folder make room for them.

    Args:
        index: Of shards at a URL; its `root` is the folder of the copies.
        limit: Bytes that the folder may have, those of other sets of shards included.
    """

    def __init__(self, index: Index, limit: int) -> None:
        assert index.url is not None
        self.folder, self.url, self.limit = index.root, index.url, limit
        self._own = frozenset(f"{shard.sha256}.tar" for shard in index.shards)
        self._begin()

    def _begin(self) -> None:
        self._counting = threading.Lock()
        self._downloaded = 0
        self._full = (0.0, 0)  # until when, for how many bytes

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_counting", "_downloaded", "_full")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def count(self, size: int) -> None:
        """Count bytes that were downloaded."""
        with self._counting:
            self._downloaded += size

    def take_count(self) -> int:
        """Return the bytes downloaded by this process since the last call."""
        with self._counting:
            taken, self._downloaded = self._downloaded, 0
        return taken

    def open(self, shard: ShardRecord) -> IO[bytes] | None:
        """Return a shard, locked against removal until the file and its maps are closed; None: it is not
        here."""
        path = self._path(shard)
        try:
            file = path.open("rb")
        except FileNotFoundError:
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_SH)  # waits only while somebody removes it
            state = os.fstat(file.fileno())
            if state.st_nlink and state.st_size == shard.bytes:
                with contextlib.suppress(OSError):
                    os.utime(path)
                return file
            if state.st_nlink:  # altered by hand
                path.unlink(missing_ok=True)
        except BaseException:
            file.close()
            raise
        file.close()
        return None

    def has(self, shard: ShardRecord) -> bool:
        """Return whether a shard is here."""
        return self._path(shard).is_file()

    def add(self, shard: ShardRecord, wanted_now: bool = False) -> bool:
        """Download a shard, unless it is here.

        Args:
            shard: Which.
            wanted_now: Wait for another process that downloads it, remove others of the same set for it, and
                exceed the bound where all shards are in use. Otherwise only shards of other sets make room.

        Returns:
            Whether it is here now; False: there is no room, or another process is downloading it.

        Raises:
            ValueError: It arrived several times with another size or checksum.
            OSError: As `data.remote.fetch`, or the disk is full.
        """
        path = self._path(shard)
        self.folder.mkdir(parents=True, exist_ok=True)
        while not path.is_file():
            until, size = self._full
            if not wanted_now and time.monotonic() < until and shard.bytes >= size:
                return False
            with self._partial(shard) as partial:
                if partial is None:
                    if not wanted_now:
                        return False
                    time.sleep(POLL_S)
                    continue
                if path.is_file():  # made between our look and our lock
                    return True
                with self._alone():
                    if not self._make_room(shard.bytes, partial, wanted_now):
                        self._full = (time.monotonic() + LOOK_AGAIN_S, shard.bytes)
                        return False
                self._download(shard, partial)
                os.replace(partial, path)
        return True

    def _download(self, shard: ShardRecord, partial: Path) -> None:
        source = remote.join(self.url, shard.file)
        try:
            remote.download(source, partial, size=shard.bytes, sha256=shard.sha256, report=self.count)
        except OSError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise OSError(
                    f"no room for {remote.shown(source)} in {self.folder}: {cause.strerror}; make room, "
                    "lower --data.cache_gb, or set PENUMBRA_CACHE to a folder on another disk"
                ) from error
            raise

    def _path(self, shard: ShardRecord) -> Path:
        return self.folder / f"{shard.sha256}.tar"

    @contextlib.contextmanager
    def _partial(self, shard: ShardRecord) -> Iterator[Path | None]:
        """Hold the partial file of a shard; None: somebody else has it, or had it.

        Nobody waits for this lock: the file becomes the shard, whose readers hold it as long as they run.
        """
        path = self.folder / f".{shard.sha256}.{shard.bytes}.partial"
        with path.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield None
                return
            if not _is_still(path, file):
                yield None
                return
            try:
                yield path
            finally:
                if _is_still(path, file):
                    path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the lock under which sizes are added up and shards are removed."""
        with (self.folder / ".lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _make_room(self, needed: int, mine: Path, wanted_now: bool) -> bool:
        """Remove what nobody uses until so many bytes more are within the bound; False: that cannot be."""
        used = sum(_reserved(path) for path in self.folder.glob(".*.partial") if path != mine)
        found = []
        for path in self.folder.glob("*.tar"):
            with contextlib.suppress(FileNotFoundError):
                state = path.stat()
                found.append((state.st_mtime_ns, state.st_size, path))
                used += state.st_size
        too_much = max(used + needed - self.limit, needed + FREE - shutil.disk_usage(self.folder).free)
        with contextlib.ExitStack() as stack:
            unused = []
            for _, size, path in sorted(found):
                if too_much <= 0:
                    break
                if (wanted_now or path.name not in self._own) and _lock_unused(path, stack):
                    unused.append(path)
                    too_much -= size
            if too_much > 0 and not wanted_now:
                return False
            for path in unused:
                path.unlink(missing_ok=True)
        return True


def _is_still(path: Path, file: IO[bytes]) -> bool:
    """Return whether a name still means the file that was opened."""
    try:
        return path.stat().st_ino == os.fstat(file.fileno()).st_ino
    except FileNotFoundError:
        return False


def _lock_unused(path: Path, stack: contextlib.ExitStack) -> bool:
    """Lock a shard until the stack is left; False where somebody uses it."""
    try:
        file = path.open("r+b")  # network file systems lock exclusively only for those who may write
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()  # there may be more shards than files that a process may open
        return False
    stack.enter_context(file)
    return True


def _reserved(partial: Path) -> int:
    """Return the bytes that a download will take; what a dead process left is removed and takes none."""
    try:
        with partial.open("r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_still(partial, file):
                partial.unlink(missing_ok=True)
    except FileNotFoundError:
        return 0
    except OSError:  # locked, or not to be locked here
        return int(partial.name.split(".")[2])
    return 0
