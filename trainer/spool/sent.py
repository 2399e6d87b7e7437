"""How far the tracking store has the journal of a run, may have it, and how many events it lacks."""

from __future__ import annotations

import contextlib
import json
import os
from array import array
from bisect import bisect_right
from dataclasses import asdict, dataclass
from pathlib import Path

from trainer.runs import RunRecord
from trainer.spool.journal import SPOOL, events, journal_size

LIMIT = "limit"


@dataclass
class Sent:
    """How far a journal was delivered, kept in `spool/sent.json`.

    Attributes:
        run_id: Run that took it.
        offset: Bytes of the journal that were sent.
        created: Whether the run was made for this journal, rather than found in an old record.
        rejected: Number of entries that the store refused.
    """

    run_id: str | None = None
    offset: int = 0
    created: bool = False
    rejected: int = 0

    @classmethod
    def load(cls, folder: Path) -> Sent:
        """Return the state of a run folder, that of nothing sent where it is absent or damaged."""
        try:
            return cls(**json.loads((folder / SPOOL / "sent.json").read_text()))
        except (OSError, ValueError, TypeError):
            return cls()

    def save(self, folder: Path) -> None:
        """Write it whole or not at all; on a full disk not, after which some is sent again."""
        path = folder / SPOOL / "sent.json"
        partial = path.with_suffix(f".{os.getpid()}.tmp")
        try:
            partial.write_text(json.dumps(asdict(self)) + "\n")
            os.replace(partial, path)
        except OSError:
            partial.unlink(missing_ok=True)


def keep_limit(folder: Path, offset: int | None) -> None:
    """Keep how many bytes of a run's journal the store may have, None for all of them.

    The process that trains may be killed: who sends the journal afterwards has to know.
    """
    path = folder / SPOOL / LIMIT
    with contextlib.suppress(OSError):  # on a full disk the old one stays, which is lower
        if offset is None:
            path.unlink(missing_ok=True)
        else:
            partial = path.with_suffix(f".{os.getpid()}.tmp")
            partial.write_text(f"{offset}\n")
            os.replace(partial, path)


def kept_limit(folder: Path) -> int | None:
    """Return how many bytes of a run's journal the store may have, None where nothing limits them."""
    try:
        return int((folder / SPOOL / LIMIT).read_text())
    except FileNotFoundError:
        return None
    except ValueError:
        return 0


class Backlog:
    """Counts the events of a run's journal that the store does not have yet; reads every line once.

    Args:
        folder: Folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._run: str | None = None
        self._ends = array("q")

    def __call__(self) -> int:
        """Return the number."""
        sent, run = Sent.load(self.folder), RunRecord.load(self.folder).run_id
        start = sent.offset if sent.run_id == run else 0
        if run != self._run or journal_size(self.folder) < (self._ends[-1] if self._ends else 0):
            self._run, self._ends = run, array("q")
        read = self._ends[-1] if self._ends else start
        self._ends.extend(offset for _, offset in events(self.folder, read))
        return len(self._ends) - bisect_right(self._ends, start)


def left(folder: Path) -> int:
    """Return how many events of a run's journal the store does not have yet."""
    return Backlog(folder)()
