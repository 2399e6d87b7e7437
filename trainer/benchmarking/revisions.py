"""Two revisions of the checkout side by side: their packages in a temporary folder."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from trainer.benchmarking.process import ROOT

HERE = "."
"""Stands for the files of the checkout as they are."""


@contextmanager
def unpacked(revisions: Sequence[str], checkout: Path = ROOT) -> Iterator[dict[str, Path]]:
    """Yield for each revision the folder that holds its packages; the checkout stays as it is.

    Args:
        revisions: Anything that names a commit, or `.` for the files as they are now.
        checkout: Folder of the repository.

    Raises:
        ValueError: This is no checkout, or has no such revision.
    """
    with TemporaryDirectory(prefix="penumbra-revisions-") as folder:
        places = {}
        for number, revision in enumerate(revisions):
            places[revision] = checkout
            if revision != HERE:
                commit = _commit(revision, checkout)
                places[revision] = Path(folder) / f"{number}-{commit[:10]}"
                _unpack(commit, checkout, places[revision])
        yield places


def _commit(revision: str, checkout: Path) -> str:
    top = _git(checkout, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != checkout.resolve():
        raise ValueError(
            f"--revisions compares commits of a checkout of Penumbra, but {checkout} is an installation; "
            "clone the repository and install it with `pip install -e .`"
        )
    commit = _git(checkout, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    if commit is None:
        raise ValueError(
            f"--revisions {revision}: the repository {checkout} has no such revision; expected a commit, "
            f"branch or tag, or {HERE} for the files as they are now"
        )
    return commit


def _git(checkout: Path, *arguments: str) -> str | None:
    """Return what git prints, None where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(checkout), *arguments], capture_output=True, text=True, check=False, timeout=60
        )
    except FileNotFoundError as error:
        raise ValueError("--revisions needs git, which is not installed") from error
    return done.stdout.strip() if done.returncode == 0 else None


def _unpack(commit: str, checkout: Path, folder: Path) -> None:
    """Write the files of a commit into a folder.

    Through an index of its own, not a worktree: nothing stays in the repository if this process is killed.
    """
    folder.mkdir()
    environment = os.environ | {"GIT_INDEX_FILE": str(folder / ".index")}
    for command in (["read-tree", commit], ["checkout-index", "--all", f"--prefix={folder}{os.sep}"]):
        whole = ["git", "-C", str(checkout), *command]
        done = subprocess.run(whole, env=environment, capture_output=True, text=True, timeout=600)
        if done.returncode:
            first = (done.stderr.strip().splitlines() or [f"git {command[0]} failed"])[0]
            raise ValueError(f"--revisions {commit[:10]}: {first}")
