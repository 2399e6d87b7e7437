"""Results on disk: nothing is overwritten unasked, and a file appears whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def refuse_existing(paths: Iterable[Path], force: bool) -> None:
    """Stop before any work if a result is already there.

    Raises:
        ValueError: A path exists and `force` is false; the message names the first ones.
    """
    if force:
        return
    there = [path for path in paths if path.exists()]
    if there:
        listed = ", ".join(str(path) for path in there[:3]) + (" …" if len(there) > 3 else "")
        raise ValueError(f"{listed} already there ({len(there)} in all); --force replaces them")


def make_folder(folder: Path) -> None:
    """Create a folder for results and make sure that it can be written to.

    Raises:
        ValueError: The path is a file.
        OSError: The folder cannot be created or written to.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; the output must be a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"cannot write to {folder}: {error.strerror}; choose another --output") from error


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Yield a temporary path beside `target` that takes its place when the block ends without an error.

    The temporary name keeps the suffix, since writers choose a format by it.

    Raises:
        OSError: Nothing could be written (no permission, disk full); the message names `target`.
    """
    temporary = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise OSError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text whole or not at all.

    Raises:
        OSError: As `replacing`.
    """
    with replacing(path) as partial:
        partial.write_text(text)
