"""The newest checkpoint of a restarted training, brought to every node of its new group."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from trainer import runs

KEPT = ("run.json", "launch.json", "config*.yaml", "checkpoints/*.ckpt", "spool/**/*")
"""What a run needs to go on elsewhere."""


def kept_files(folder: Path) -> dict[str, Path]:
    """Return the files of a run that it needs to go on elsewhere, by their names in the folder."""
    found = {path for pattern in KEPT for path in folder.glob(pattern) if path.is_file()}
    return {str(path.relative_to(folder)): path for path in sorted(found) if not path.name.startswith(".")}


def step_of(folder: Path | None) -> int:
    """Return the step of a run's last checkpoint, 0 where it has none, -1 where there is no run."""
    if folder is None:
        return -1
    import torch

    path = folder / "checkpoints" / "last.ckpt"
    if not path.is_file():
        return 0
    return int(torch.load(path, map_location="cpu", weights_only=True, mmap=True)["global_step"])


def share_newest(root: Path, experiment: str, storage: str | None) -> None:
    """Give every node the run of this launch as the node, or the storage, with its newest checkpoint has it.

    To be called on all ranks of a group; does nothing in a first attempt.
    """
    import torch.distributed as dist

    rank = dist.get_rank()
    launch = runs.current_launch()
    if launch is None:
        return
    folder = runs.run_of_launch(launch, root, experiment)
    step = step_of(folder)
    if rank == 0 and storage:
        from trainer.cluster.storage import fetch_run

        fetched = fetch_run(storage, launch.identity, root, newer_than=step)
        if fetched is not None:
            folder, step = fetched, step_of(fetched)
    steps: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(steps, step)
    if min(steps) == max(steps):
        return
    holder = steps.index(max(steps))
    parcel: list[Any] = [_packed(folder) if rank == holder and folder is not None else None]
    dist.broadcast_object_list(parcel, src=holder)
    name, files = parcel[0]
    if step < max(steps) and os.environ.get("LOCAL_RANK", "0") == "0":
        unpack(root / experiment / name, files)
    if rank == 0:
        print(
            f"restarted: checkpoint of step {max(steps)} was brought from rank {holder}'s node",
            file=sys.stderr,
        )
    dist.barrier()


def _packed(folder: Path) -> tuple[str, dict[str, bytes]]:
    return folder.name, {name: path.read_bytes() for name, path in kept_files(folder).items()}


def unpack(folder: Path, files: dict[str, bytes]) -> None:
    """Write files of a run, `run.json` last, each whole or not at all."""
    for name in sorted(files, key=lambda name: name == runs.RUN_FILE):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        partial.write_bytes(files[name])
        os.replace(partial, path)
