"""What a Mitsuba XML file refers to: the files it is made of and its cameras. No renderer."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def scene_name(path: Path) -> str:
    """Return the name of a scene's file; that of its folder where the file is called scene.xml."""
    resolved = path.resolve()
    return resolved.parent.name if resolved.stem == "scene" else resolved.stem


def scene_files(path: Path) -> dict[str, str]:
    """Return every file that a scene is made of, as its text names it → SHA-256.

    Raises:
        ValueError: A file is missing or the XML is broken; the message names both files.
    """
    path = Path(path)
    found: dict[str, str] = {}
    for name, file in _references(path, path.name, path.parent):
        if not file.is_file():
            what = f"scene {path} does not exist" if file == path else f"scene {path}: {name} is missing"
            raise ValueError(f"{what}; expected at {file}" if file != path else f"{what}; name an XML file")
        found[name] = _sha256(file)
    return dict(sorted(found.items()))


def scene_files_hash(path: Path) -> str:
    """Return one SHA-256 of all files that a scene is made of; see `scene_files`."""
    parts = "".join(f"{name}\0{digest}\n" for name, digest in scene_files(path).items())
    return hashlib.sha256(parts.encode()).hexdigest()


def _references(
    path: Path, name: str, root: Path, within: tuple[Path, ...] = ()
) -> Iterator[tuple[str, Path]]:
    """Yield a file and, if it is XML, what it refers to; `within`: the files that include it."""
    if path in within:
        raise ValueError(f"scene {within[0]}: {name} includes itself; remove that <include>")
    yield name, path
    if path.suffix.lower() != ".xml" or not path.is_file():
        return
    tree = _xml(path)
    defaults = {e.get("name", ""): e.get("value", "") for e in tree.iter("default")}
    for element in tree.iter():
        value = element.get("filename") if element.tag == "include" else None
        if element.tag == "string" and element.get("name") == "filename":
            value = element.get("value")
        if value is not None:
            for variable in sorted(defaults, key=len, reverse=True):
                value = value.replace(f"${variable}", defaults[variable])
            yield from _references(root / value, value, root, (*within, path))


def _xml(path: Path) -> Any:
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"scene {path}: not valid XML: {error}") from None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def declared_sensors(path: Path, root: Path) -> Iterator[Any]:
    """Yield the XML elements of all cameras."""
    tree = _xml(path)
    yield from tree.iter("sensor")
    for element in tree.iter("include"):
        inner = root / (element.get("filename") or "")
        if inner.is_file():
            yield from declared_sensors(inner, root)
