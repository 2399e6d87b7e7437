"""`trainer upload`: move a run that was tracked locally to a tracking server."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from trainer.runs import RunRecord

HELP = (
    "Send a run that was tracked in the local store to a tracking server, which it belongs to from then on."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `trainer upload`."""
    parser.add_argument("run", type=Path, help="folder of the run, runs/EXPERIMENT/NAME")
    parser.add_argument(
        "--to",
        metavar="URI",
        help="server; by default the one that could not be reached, or MLFLOW_TRACKING_URI",
    )


def run(arguments: argparse.Namespace) -> int:
    """Send everything that the run recorded; returns 1 where something is left for `trainer sync`.

    Raises:
        ValueError: The folder is no run, no server is named, or it does not answer.
    """
    from trainer.commands.sync import send
    from trainer.spool.journal import SPOOL
    from trainer.spool.past import is_whole, write_journal
    from trainer.spool.sender import Lock
    from trainer.spool.sent import left
    from trainer.spool.store import is_server, unreachable

    folder: Path = arguments.run
    record = RunRecord.load(folder)
    target = arguments.to or record.unreached_uri or os.environ.get("MLFLOW_TRACKING_URI")
    if not target:
        raise ValueError("no server is known for this run; name one with --to URI")
    if record.tracking_uri == target:
        if left(folder):
            return send(folder)
        print(f"{folder} is tracked by {target} already")
        return 0
    if is_server(target) and (reason := unreachable(target)):
        raise ValueError(f"the tracking server {target} cannot be reached ({reason}); nothing was sent")
    (folder / SPOOL).mkdir(exist_ok=True)
    lock = Lock(folder)
    if not lock.acquire():
        raise ValueError(
            f"another process sends {folder}: its training, or `trainer sync`; try again when that has ended"
        )
    try:
        if not is_whole(folder):
            write_journal(folder)
        record.tracking_uri, record.run_id = target, record.server_run_id
        record.unreached_uri = record.server_run_id = None
        record.save(folder)
    finally:
        lock.release()
    return send(folder)
