"""Noisy images and their references by name: `0001.exr` and `ref/0001.exr`, `a_4spp.exr` and `a_1024spp.exr`.

A word of a file's name, or a whole folder, may say what an image is: `ref`, `reference`, `gt`, `target` mark
the reference, `16spp` the samples per pixel, `noisy` or `input` nothing more. Images whose paths are alike
without these words are versions of one frame. The marked one is its reference, otherwise the one with the
most samples, and a single one has none. What remains of the name is scene and frame number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from data.layouts.channels import REFERENCE_WORDS
from data.layouts.walk import files_below

_WORDS = rf"(?P<word>{'|'.join(REFERENCE_WORDS)}|noisy|inputs?|(?P<spp>\d{{1,9}})_?spp)"
_WORD = re.compile(rf"(?:^|(?<=[_\-. ])){_WORDS}(?=$|[_\-. ])", re.IGNORECASE)
_FOLDER = re.compile(_WORDS, re.IGNORECASE)
_EDGES = "_-. "


@dataclass(frozen=True)
class Job:
    """One frame: a noisy image and its reference.

    Attributes:
        path: The noisy image.
        spp: Its samples per pixel, None where its name does not say.
        reference: The reference, None where there is none.
        reference_spp: Its samples per pixel, None where its name does not say.
        view: Number of the view, where a scene has several noisy images of a view.
    """

    path: Path
    spp: int | None
    reference: Path | None
    reference_spp: int | None
    view: int | None


@dataclass(frozen=True)
class SceneFiles:
    """The frames of one scene.

    Attributes:
        jobs: Frame number → its files, ascending.
        consecutive: There are several, numbered without a gap, one noisy image each.
    """

    jobs: dict[int, Job]
    consecutive: bool


@dataclass(frozen=True)
class _Version:
    path: Path
    spp: int | None
    marked: bool


def scenes_of(root: Path) -> dict[str, SceneFiles]:
    """Return the scenes among the EXR files below a root, sorted by name.

    Raises:
        ValueError: Two references, or two noisy images of as many samples, of one frame; names both.
    """
    frames: dict[tuple[str, str], list[_Version]] = {}
    for path in files_below(root, (".exr",)):
        folders, stem, version = _parsed(path, path.relative_to(root))
        prefix, number = _numbered(stem)
        scene = "-".join(filter(None, (*folders, prefix))) or root.resolve().name
        frames.setdefault((scene, number), []).append(version)
    scenes: dict[str, dict[str, list[_Version]]] = {}
    for (scene, number), versions in sorted(frames.items()):
        scenes.setdefault(scene, {})[number] = versions
    return {scene: _scene(members) for scene, members in scenes.items()}


def _parsed(path: Path, below: Path) -> tuple[list[str], str, _Version]:
    words = list(_WORD.finditer(path.stem))
    folders = []
    for part in below.parts[:-1]:
        match = _FOLDER.fullmatch(part)
        if match is None:
            folders.append(part)
        else:
            words.append(match)
    stem = re.sub(r"[_\-. ]{2,}", "_", _WORD.sub("", path.stem)).strip(_EDGES)
    counts = [int(word["spp"]) for word in words if word["spp"]]
    marked = any(word["word"].lower() in REFERENCE_WORDS for word in words)
    return folders, stem, _Version(path, counts[0] if counts else None, marked)


def _numbered(stem: str) -> tuple[str, str]:
    match = re.search(r"\d{1,9}$", stem)
    return (stem[: match.start()].strip(_EDGES), match.group()) if match else (stem, "")


def _scene(members: dict[str, list[_Version]]) -> SceneFiles:
    order = sorted(members, key=lambda number: (int(number or 0), number))
    views = [_split(members[number]) for number in order]
    numbers = [int(number or 0) for number in order]
    single = all(len(inputs) == 1 for inputs, _ in views) and len(set(numbers)) == len(numbers)
    listed: list[tuple[int, Job]] = []
    for view, (inputs, reference) in enumerate(views):
        for noisy in inputs:
            job = Job(
                noisy.path,
                noisy.spp,
                None if reference is None else reference.path,
                None if reference is None else reference.spp,
                None if single else view,
            )
            listed.append((numbers[view] if single else len(listed), job))
    gapless = numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    return SceneFiles(dict(listed), single and len(listed) > 1 and gapless)


def _split(versions: list[_Version]) -> tuple[list[_Version], _Version | None]:
    marked = [v for v in versions if v.marked]
    noisy = sorted((v for v in versions if not v.marked), key=lambda v: v.spp or 0)
    for one, two in pairwise(marked):
        raise ValueError(f"{one.path} and {two.path} are references of the same frame; remove one")
    for one, two in pairwise(noisy):
        if one.spp == two.spp:
            raise ValueError(f"{one.path} and {two.path} are the same frame with as many samples; remove one")
    if not noisy:
        raise ValueError(f"{marked[0].path} is a reference, but its noisy image is missing")
    if not marked and len(noisy) > 1:
        return noisy[:-1], noisy[-1]
    return noisy, marked[0] if marked else None
