"""The folder of an evaluation: whose frames it is for, and the rows that need not be made again.

In it `data.json` says which frames, and has an identifier of the evaluation; `rows.jsonl` has a row for each
frame and method, as they come; `images` holds what methods made.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
import uuid
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from data.root import SAMPLE, resolve_root
from trainer.clips import Clip
from trainer.evaluation.plan import INPUT, PLACES, REFERENCE, Method, Setting
from trainer.outputs import replacing

ROWS, DATA, IMAGES = "rows.jsonl", "data.json", "images"
MADE = (ROWS, DATA, IMAGES, "evaluation.json", "rows.parquet", "rows.csv", "report.html", "tables", "plots",
        "pictures", "logs", "costs.json")  # fmt: skip
"""All that an evaluation writes."""
Row = dict[str, Any]


def identity_of(root: str, clips: Sequence[Clip]) -> str:
    """Return what tells the frames of a data set from others: names, and files by place, size and time."""
    path = Path(resolve_root(root).path) if root.startswith(SAMPLE) else Path(root).expanduser()
    items = [item for clip in clips for item in clip.items]
    files = [item.source for item in items if item.source is not None]
    if not files:  # the frames of some layouts are made of several files
        files = [file for file in sorted(path.rglob("*")) if file.is_file()]
    if (path / "manifest.json").is_file():
        files.append(path / "manifest.json")
    told = [str(path.resolve()), *(item.name for item in items)]
    for file in files:
        state = file.stat()
        told.append(f"{file} {state.st_size} {state.st_mtime_ns}")
    return hashlib.sha256("\n".join(told).encode()).hexdigest()


def take_folder(folder: Path, identity: str, root: str, force: bool = False) -> None:
    """Make a folder, or find the evaluation in it that is to go on.

    Args:
        folder: The folder.
        identity: Of the frames.
        root: Their data set, as the user named it.
        force: Discard an evaluation of other frames.

    Raises:
        ValueError: It holds something else than an evaluation, or one of other frames.
        OSError: It cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    there = {path.name for path in folder.iterdir()}
    if there and not there & {DATA, ROWS, "evaluation.json"}:
        raise ValueError(f"{folder} holds something else than an evaluation; choose another --output")
    held = _held(folder)
    if held.get("identity") == identity:
        return
    if there and not force:
        raise ValueError(
            f"{folder} holds an evaluation of {held.get('data', 'something else')} whose frames are others, "
            "or were changed since; choose another --output, or discard it with --force"
        )
    for name in there & set(MADE):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    with replacing(folder / DATA) as partial:
        record = {"id": uuid.uuid4().hex, "identity": identity, "data": root}
        partial.write_text(json.dumps(record, indent=1) + "\n")


def id_of(folder: Path) -> str:
    """Return the identifier of the evaluation in a folder."""
    return str(_held(folder).get("id", ""))


def _held(folder: Path) -> dict[str, Any]:
    try:
        record = json.loads((folder / DATA).read_text())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


class Kept:
    """The rows on disk, one JSON object a line; a line that was cut off by a kill or a full disk is left out.

    Args:
        folder: Of the evaluation.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / ROWS
        self._lock = threading.Lock()
        self._rows: list[Row] = []
        lines = self.path.read_bytes().splitlines(keepends=True) if self.path.is_file() else []
        whole = []
        for line in lines:
            if (row := _row(line)) is not None:
                self._rows.append(row)
                whole.append(line)
        if whole != lines:
            with replacing(self.path) as partial:
                partial.write_bytes(b"".join(whole))

    def of(self, method: Method, identity: str) -> dict[str, Row]:
        """Return the rows of a method that need not be made again.

        They were made as now, did not fail, and their pictures are there.
        """
        made = (row for row in self._rows if (row["method"], row["identity"]) == (method.label, identity))
        found = {row["name"]: row for row in made}
        return {
            name: row
            for name, row in found.items()
            if row["status"] != "failed" and all(path.is_file() for path in self._pictures(row, method))
        }

    def _pictures(self, row: Row, method: Method) -> Iterable[Path]:
        images, name = self.folder / IMAGES, row["name"]
        yield images / method.folder / f"{name}.exr"
        if method.label == INPUT and row.get("reference"):
            yield images / REFERENCE / f"{name}.exr"
        if method.label == INPUT and row.get("places"):
            yield images / PLACES / f"{name}.npz"

    def add(self, row: Row) -> None:
        """Keep a row.

        Raises:
            OSError: There is no space; nothing of it is kept.
        """
        line = json.dumps(row).encode() + b"\n"
        with self._lock, self.path.open("ab") as file:
            before = file.tell()
            try:
                file.write(line)
                file.flush()
            except OSError:
                os.truncate(self.path, before)
                raise


def _row(line: bytes) -> Row | None:
    """Return the row of a line, None where that is damaged or has no end."""
    try:
        row = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        return None
    return row if isinstance(row, dict) and {"method", "identity", "name", "status"} <= row.keys() else None


def identity_of_rows(facts: dict[str, Any], setting: Setting) -> str:
    """Return what rows must have been made by to be taken over.

    Args:
        facts: What a worker tells of a method.
        setting: How it is run.
    """
    made = [facts[name] for name in ("class", "options", "sha256", "code", "versions")]
    return json.dumps([*made, setting.data, setting.device, setting.memory, *sorted(setting.metrics)])
