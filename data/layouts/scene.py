"""What every layout returns for a scene: its frames by number, and how to read one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from data.camera import DepthKind
from data.frame import Frame


@dataclass(frozen=True)
class Scene:
    """One scene of a layout.

    Attributes:
        name: Unique within the root.
        indices: Numbers of its frames, ascending.
        read: Number → frame. A partial of a module-level function, so that other processes can call it.
        depth: What depth means here.
        sequence: Consecutive frames of one camera path.
        thresholds: Limits for accumulation, where the layout knows them.
        credit: Author, where known.
        license: Terms, where known.
        provenance: How it was made, where known.
    """

    name: str
    indices: tuple[int, ...]
    read: Callable[[int], Frame]
    depth: DepthKind
    sequence: bool = True
    thresholds: dict[str, float] = field(default_factory=dict)
    credit: str = ""
    license: str = ""
    provenance: str = ""


def all_frames(scenes: list[Scene]) -> Iterator[Frame]:
    """Read the frames of all scenes, one at a time."""
    for scene in scenes:
        for index in scene.indices:
            yield scene.read(index)


def subfolders(root: Path) -> list[Path]:
    """Return the folders directly in a folder, sorted, hidden ones left out."""
    return sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))


def require_folder(root: Path) -> None:
    """Raise an error unless the root is a folder with something in it."""
    if not root.exists():
        raise FileNotFoundError(f"{root} does not exist")
    if not root.is_dir():
        raise ValueError(f"{root} is a file, expected a folder of scenes")
    if not any(root.iterdir()):
        raise ValueError(f"{root} is empty, expected a folder of scenes")
