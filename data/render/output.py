"""The folder of a rendered data set: what may be rendered into it, what gives way, and whether it fits."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.ingestion import remove_set
from data.manifest import MANIFEST, load_manifest, write_json
from data.render.recipe import ADDITIONS, Recipe
from data.render.views import WORK, ViewWork

JOB = "job.json"

_OPTIONS = {
    "kind": "kind",
    "width": "--size, columns",
    "height": "--size, rows",
    "spp": "--spp",
    "max_depth": "--max-depth",
    "chunk": "--memory, samples at once",
    "version": "version of the recipe",
    "histogram": "--histogram",
    "histogram_exposure": "--histogram-exposure",
    "second_hit": "--second-hit",
}


@dataclass(frozen=True)
class Obstacles:
    """What has to go before a data set can be rendered.

    Attributes:
        everything: The folder holds frames of another recipe or of another origin.
        memories: Files that remember views which are not part of the data set.
    """

    everything: bool = False
    memories: tuple[Path, ...] = ()


def examine(root: Path, recipe: Recipe, works: Mapping[str, list[ViewWork]], force: bool) -> Obstacles:
    """Find out whether a data set can be rendered into a folder; changes nothing.

    Args:
        root: The folder.
        recipe: What is rendered.
        works: The views of every scene.
        force: What is in the way may be removed.

    Raises:
        OSError: The folder is a file.
        ValueError: It holds frames of another recipe or other scenes and `force` is not set, or something
            that was not rendered.
    """
    if root.exists() and not root.is_dir():
        raise OSError(f"{root} is a file; --output must name a folder")
    if not root.is_dir():
        return Obstacles()
    known = _known_recipe(root)
    if known is None:
        strange = [path.name for path in root.iterdir() if path.name != WORK]
        if strange and not (force and (root / MANIFEST).is_file()):
            raise ValueError(f"{root} is not empty and was not rendered; choose an empty or new --output")
        return Obstacles(everything=bool(strange))
    if not recipe.same_work(known):
        if not force:
            raise ValueError(
                f"{root} holds frames of another recipe ({_difference(recipe, known)}); --force replaces "
                "them, or choose another --output"
            )
        return Obstacles(everything=True)
    return Obstacles(memories=_left_over(root, works, force))


def _left_over(root: Path, works: Mapping[str, list[ViewWork]], force: bool) -> tuple[Path, ...]:
    """Return the memories of views that are not planned; refuse them unless they may be removed."""
    planned = {(work.scene, work.key) for scene in works.values() for work in scene}
    names = {path: str(_memory(path).get("scene")) for path in _memories(root)}
    left = {path: name for path, name in names.items() if (name, path.stem) not in planned}
    changed = sorted({name for name in left.values() if name in works})
    others = sorted(set(left.values()) - set(works))
    if changed and not force:
        raise ValueError(
            f"{root} holds another scene {changed[0]!r}: its file, camera, probabilities or number of frames "
            "were different; --force replaces it, or choose another --output"
        )
    if others and not force:
        told = ", ".join(others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
        raise ValueError(
            f"{root} also holds {told}, which this command does not name; name all scenes that the data set "
            "shall have, choose another --output, or --force removes them"
        )
    return tuple(left)


def prepare(root: Path, recipe: Recipe, obstacles: Obstacles) -> None:
    """Remove what is in the way and note what is rendered.

    Raises:
        OSError: The folder cannot be written.
    """
    memories = _memories(root) if obstacles.everything else obstacles.memories
    for path in memories:
        _forget(root, path)
    if obstacles.everything:
        if (root / MANIFEST).is_file():
            remove_set(root)
        shutil.rmtree(root / WORK, ignore_errors=True)
    try:
        (root / WORK).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot write to {root}: {error.strerror}; choose another --output") from error
    write_json(root / WORK / JOB, recipe.to_json())


def bytes_of(recipe: Recipe, views: int) -> int:
    """Return about how many bytes a data set takes: channels times two or four bytes, less what ZIP saves."""
    # Most bins are 0, so that ZIP saves half of their four bytes.
    stills = 90 + 60 * recipe.histogram + 30 * recipe.second_hit
    channels = {"stills": stills, "sequences": 26, "samples": 20 * recipe.spp[0] + 14}[recipe.kind]
    frames = len(recipe.spp) if recipe.kind == "stills" else 1
    sums = 9 * 8
    return int(views * recipe.pixels * (channels * 2.0 * frames + sums))


def check_room(root: Path, need: int) -> None:
    """Raise an OSError if a number of bytes does not fit on the disk."""
    free = shutil.disk_usage(root).free
    if need > free:
        raise OSError(
            f"{root}: about {_size(need)} are needed and {_size(free)} are free; choose another "
            "--output, fewer scenes or a smaller --size"
        )


def _size(number: int) -> str:
    return f"{number / 1e9:.1f} GB" if number >= 1e9 else f"{number / 1e6:.2g} MB"


def _known_recipe(root: Path) -> dict[str, Any] | None:
    """Return the recipe of what is there; None where nothing was rendered, as after a call that failed."""
    if any(_memories(root)) or (root / MANIFEST).is_file():
        values = _memory(root / WORK / JOB)
        if values:
            return values
        try:
            return load_manifest(root).recipe.get("recipe")
        except (OSError, ValueError):
            return None
    return None


def _difference(recipe: Recipe, known: dict[str, Any]) -> str:
    mine = recipe.to_json() | {name: getattr(recipe, name) for name in ADDITIONS}
    known = ADDITIONS | known
    names = [n for n in mine if n != "reference_spp" and mine[n] != known.get(n)]
    return ", ".join(f"{_OPTIONS[n]} {_plain(known.get(n))} instead of {_plain(mine[n])}" for n in names)


def _plain(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _memories(root: Path) -> list[Path]:
    return sorted((root / WORK / "views").glob("*.json"))


def _memory(path: Path) -> dict[str, Any]:
    """Return a JSON object, empty where there is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def _forget(root: Path, path: Path) -> None:
    """Remove a view: its frames, the sums of its reference, and its memory."""
    (root / WORK / "references" / f"{path.stem}.npz").unlink(missing_ok=True)
    _remove(root, (record["file"] for record in _memory(path).get("records", [])))
    path.unlink(missing_ok=True)


def _remove(root: Path, files: Iterable[str]) -> None:
    for name in files:
        file = root / name
        file.unlink(missing_ok=True)
        if file.parent != root and file.parent.is_dir() and not any(file.parent.iterdir()):
            file.parent.rmdir()
