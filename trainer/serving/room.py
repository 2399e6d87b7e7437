"""Space in the temporary folder, which all requests share: uploads, what ZIP files unpack to, results."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from pathlib import Path

from trainer.serving.limits import Refusal

RETRY = {"Retry-After": "5"}
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Room:
    """Bytes that requests share: who wants more than is left is refused.

    Args:
        total: Bytes.
    """

    def __init__(self, total: int) -> None:
        self.total, self.taken = total, 0
        self._lock = threading.Lock()

    def take(self, size: int) -> None:
        """Take bytes.

        Raises:
            Refusal: Others have them.
        """
        with self._lock:
            self.check(size)
            self.taken += size

    def check(self, size: int) -> None:
        """Raise as `take` does, and take nothing."""
        if self.taken + size > self.total:
            raise no_room()

    def give_back(self, size: int) -> None:
        """Leave bytes to others."""
        with self._lock:
            self.taken -= size


class Place:
    """The folder of one request, and the room that its files take.

    Args:
        folder: It, which need not exist.
        room: That of all requests.

    Attributes:
        upload: Folder of the uploaded file and what is made of it.
    """

    def __init__(self, folder: Path, room: Room) -> None:
        self.folder, self.upload, self.room = folder, folder / "upload", room
        self._held = 0
        self._lock = threading.Lock()

    def check(self, size: int) -> None:
        """Raise as `take` does, and take nothing."""
        if self._held + size > self.room.total:
            raise Refusal(
                413,
                f"the request takes more than {self.room.total / 1e6:g} MB with what it unpacks to and its "
                "results, which is the most that is taken; send fewer frames",
            )
        self.room.check(size)

    def take(self, size: int) -> None:
        """Take room before bytes are written.

        Raises:
            Refusal: 413 where one request may not have so much, 503 where others have it at present.
        """
        with self._lock:
            self.check(size)
            self.room.take(size)
            self._held += size

    def give_back(self, size: int) -> None:
        """Leave room that was taken and is not needed."""
        with self._lock:
            self._held -= size
            self.room.give_back(size)

    def remove(self) -> None:
        """Remove the files and leave their room to others; may be repeated."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with self._lock:
            self.room.give_back(self._held)
            self._held = 0


def no_room() -> Refusal:
    """Return the answer to a request whose files find no room."""
    return Refusal(503, "the server has no room for more files at present; try again in 5 s", dict(RETRY))


def is_full(error: BaseException) -> bool:
    """Return whether an error, or what it came from, is that of a full disk."""
    found: BaseException | None = error
    while found is not None:
        # OpenEXR tells the reason in its message only.
        if getattr(found, "errno", None) in _FULL or os.strerror(errno.ENOSPC) in str(found):
            return True
        found = found.__cause__
    return False
