"""The newest state of a restarted training, brought to every node of its new group."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from trainer import runs
from trainer.spool.sent import LIMIT

CHECKPOINTS = ("checkpoints/*.ckpt",)
KEPT = ("run.json", "launch.json", "config*.yaml", *CHECKPOINTS, "spool/**/*")
"""What a run needs to go on elsewhere."""

OWN = ("lock", LIMIT)
"""Names of files that mean something on this node only."""

NOTHING = (-1, -1)
"""What is reached where there is no run."""


def kept_files(folder: Path, patterns: Iterable[str] = KEPT) -> dict[str, Path]:
    """Return the files of a run that it needs to go on elsewhere, by their names in the folder."""
    found = {path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}
    kept = [path for path in sorted(found) if path.name[0] != "." and path.suffix != ".tmp"]
    return {str(path.relative_to(folder)): path for path in kept if path.name not in OWN}


def whole_last(names: Iterable[str]) -> list[str]:
    """Return names of files in an order that leaves a run which is not all there behind one that is."""
    late = (runs.LAUNCH_FILE, runs.RUN_FILE)
    return sorted(names, key=lambda name: (late.index(name) if name in late else -1, name))


def reached(folder: Path | None) -> tuple[int, int]:
    """Return how far a run is: the attempt of its launch, and the step of its last checkpoint.

    The attempt counts first: a node may have saved a later step than the one that the next attempt began from
    elsewhere, but the tracking store has what that attempt recorded.

    Raises:
        ValueError: The checkpoint is damaged.
    """
    if folder is None:
        return NOTHING
    path = folder / "checkpoints" / "last.ckpt"
    if not path.is_file():
        return runs.attempt_of(folder), 0
    from trainer.reading import read_checkpoint

    step = read_checkpoint(path).get("global_step")
    if not isinstance(step, int):
        raise ValueError(f"{path} is not a checkpoint of `trainer fit`: it has no global_step")
    return runs.attempt_of(folder), step


def share_newest(root: Path, experiment: str, storage: str | None) -> bool:
    """Give every node the run of this launch as the node, or the storage, that is furthest has it.

    To be called on all ranks of a group. In a first attempt there is no such run, and nothing happens.

    Returns:
        Whether the run is finished, so that nothing is left to do.

    Raises:
        OSError: The storage cannot be read, and no node has the run.
        ValueError: What the storage has is damaged, and no node has the run.
    """
    import torch.distributed as dist

    rank = dist.get_rank()
    launch = runs.current_launch()
    if launch is None:
        return False
    done = runs.finished_by_launch(launch, root, experiment) is not None
    folder = runs.run_of_launch(launch, root, experiment)
    trouble: Exception | None = None
    if rank == 0 and storage and not done:
        folder, trouble = _with_storage(storage, launch.identity, root, folder)
        done = launch.once and trouble is None and _finished_there(storage, launch.identity)
    mine = reached(folder)
    gathered: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(gathered, (mine, done))
    if any(finished for _, finished in gathered):
        if rank == 0:
            print("restarted: the run is finished, nothing is left to do", file=sys.stderr)
        return True
    states = [state for state, _ in gathered]
    furthest = max(states)
    if trouble is not None:
        if furthest == NOTHING:
            raise trouble
        print(
            f"warning: {trouble}. The training goes on from the checkpoint of step {furthest[1]} on this "
            "cluster's nodes; a later one in the storage would be lost.",
            file=sys.stderr,
        )
    if min(states) == furthest:
        return False
    holder = states.index(furthest)
    parcel: list[Any] = [_packed(folder) if rank == holder and folder is not None else None]
    dist.broadcast_object_list(parcel, src=holder)
    name, files = parcel[0]
    if mine < furthest and os.environ.get("LOCAL_RANK", "0") == "0":
        unpack(root / experiment / name, files)
    if rank == 0:
        print(
            f"restarted: checkpoint of step {furthest[1]} was brought from rank {holder}'s node",
            file=sys.stderr,
        )
    dist.barrier()
    return False


def _finished_there(storage: str, launch: str) -> bool:
    from trainer.cluster.storage import is_finished

    try:
        return is_finished(storage, launch)
    except (OSError, ValueError):
        return False


def _with_storage(
    storage: str, launch: str, root: Path, folder: Path | None
) -> tuple[Path | None, Exception | None]:
    """Return the run of this machine, or of a storage that is further, and what made that unreadable."""
    from trainer.cluster.storage import fetch_run

    try:
        return fetch_run(storage, launch, root, newer_than=reached(folder)) or folder, None
    except (OSError, ValueError) as error:
        return folder, error


def _packed(folder: Path) -> tuple[str, dict[str, bytes]]:
    return folder.name, {name: path.read_bytes() for name, path in kept_files(folder).items()}


def unpack(folder: Path, files: dict[str, bytes]) -> None:
    """Write files of a run, `run.json` last, each whole or not at all."""
    for name in whole_last(files):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        partial.write_bytes(files[name])
        os.replace(partial, path)
