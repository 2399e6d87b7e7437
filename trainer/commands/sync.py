"""`trainer sync`: send to the tracking store what runs could not deliver."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.configs import UsageError
from trainer.runs import RUN_FILE, RunRecord

if TYPE_CHECKING:
    from trainer.spool.delivery import Delivery

HELP = "Send to the tracking store what runs recorded while it could not be reached."
TRIES = 3
"""How often a store that does not answer is asked, a few seconds apart."""
UNMIRRORED = (
    "They were recorded after the run's last copy to its mirror, and are recorded again where it goes on "
    "from there; if it never will, --unmirrored sends them."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `trainer sync`."""
    parser.add_argument(
        "runs", nargs="*", type=Path, metavar="RUN", help="folders of runs, runs/EXPERIMENT/NAME"
    )
    parser.add_argument("--all", action="store_true", help="every run below --root that has something left")
    parser.add_argument(
        "--unmirrored",
        action="store_true",
        help="also what a mirrored run recorded after its last copy; only if it will never go on from there",
    )
    parser.add_argument("--root", type=Path, default=Path("runs"), help="folder of all runs (default: runs)")


def run(arguments: argparse.Namespace) -> int:
    """Send what is left; returns 1 where something still is.

    Raises:
        UsageError: No run is named.
        ValueError: A folder is not a run.
    """
    if not arguments.runs and not arguments.all:
        raise UsageError("name the folders of runs (runs/EXPERIMENT/NAME), or give --all")
    folders = list(arguments.runs)
    for folder in folders:
        RunRecord.load(folder)
    if arguments.all:
        found = sorted(path.parent for path in arguments.root.glob(f"*/*/{RUN_FILE}"))
        folders += [folder for folder in found if _has_left(folder)]
        if not folders:
            print(f"nothing is left to send below {arguments.root}")
    return max([_sent(folder, arguments.unmirrored) for folder in folders], default=0)


def _has_left(folder: Path) -> bool:
    """Return whether a run has something left, or is so damaged that `_sent` has to tell."""
    from trainer.spool.sent import left

    try:
        return left(folder) > 0
    except (ValueError, OSError):
        return True


def _sent(folder: Path, unmirrored: bool) -> int:
    """Send what is left of one run; a damaged one does not keep the others from being sent."""
    try:
        return send(folder, unmirrored)
    except (ValueError, OSError) as error:
        print(f"{folder}: {error}", file=sys.stderr)
        return 1


def send(folder: Path, unmirrored: bool = False) -> int:
    """Send what is left of one run and print it; returns 1 where something still is.

    Args:
        folder: Folder of the run.
        unmirrored: Also what is not in the mirror that the run had. Where the run goes on from that, it is
            recorded again, and the store would have it twice.
    """
    from trainer.spool.delivery import Delivery
    from trainer.spool.sender import Lock
    from trainer.spool.sent import keep_limit, kept_limit, left
    from trainer.spool.store import load_mlflow, quiet_mlflow

    waiting = left(folder)
    if not waiting:
        print(f"{folder}: nothing is left to send")
        return 0
    lock = Lock(folder)
    if not lock.acquire():
        print(
            f"{folder}: {waiting} events are left; another process, such as the training itself, sends them"
        )
        return 1
    quiet_mlflow(retries=0)
    if unmirrored:
        keep_limit(folder, None)
    delivery = Delivery(folder)
    delivery.limit = kept_limit(folder)
    load_mlflow(delivery.uri)
    try:
        why = _send(delivery, waiting)
    finally:
        lock.release()
    rest = left(folder)
    if rest < waiting:
        counts = f"{delivery.counts['metrics']} metric values and {delivery.counts['files']} files"
        print(f"{folder}: sent {counts} to {delivery.uri}, run {delivery.record.run_id}")
    if delivery.sent.rejected:
        print(f"{folder}: {delivery.sent.rejected} were refused; see {folder / 'spool' / 'rejected.jsonl'}")
    if rest:
        print(f"{folder}: {rest} events are left. {why}")
    return int(rest > 0)


def _send(delivery: Delivery, waiting: int) -> str:
    """Send everything; returns what keeps the rest from being sent."""
    from data.progress import LineProgress
    from trainer.spool.failures import Kind, OutageError
    from trainer.spool.sender import trouble

    progress = LineProgress(f"sending {delivery.folder}", unit="events") if sys.stderr.isatty() else None
    done = tries = 0
    while True:
        try:
            moved = delivery.step()
        except OutageError as outage:
            tries += 1
            if tries >= TRIES or outage.kind is Kind.DENIED:
                return trouble(outage, delivery.uri)
            time.sleep(2.0 * tries)
            continue
        if not moved:
            return UNMIRRORED if delivery.limit is not None else ""
        tries = 0
        done += moved
        if progress:
            progress(min(done, waiting), waiting)
