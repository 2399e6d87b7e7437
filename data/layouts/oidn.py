"""Layout of Open Image Denoise's training sets: `<name>_<spp>spp.{hdr,alb,nrm}.exr`.

One image per feature and number of samples, in any folders below the root: `hdr` is radiance, `alb` albedo,
`nrm` the shading normal. The last part of the name is a number of samples (`0016`, `16spp`) or one of
`ref`, `reference`, `gt`, `target`; without such a word the image with the most samples is the reference, and
a single image has none. Images of one folder are views of one scene, images in the root scenes of their own.

The authors allow world and view space for normals, noisy and prefiltered features, and an albedo of 1 for
mirrors and the background; what this reader assumed stands in `notes["assumed"]`.

Source: Open Image Denoise, chapter "Training" of its documentation.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from data.derive import effective_albedo
from data.exr_image import read_exr
from data.frame import Frame
from data.layouts.channels import DEFAULT, Gathering, channel_groups
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.walk import LOOK, files_below

_FILE = re.compile(
    r"(?P<name>.+?)(?:_(?P<version>\d+(?:spp)?|ref|reference|gt|target))?\.(?P<feature>[a-z][a-z0-9]{1,5})\.exr",
    re.IGNORECASE,
)
_FEATURES = {"hdr": "color", "alb": "diffuse_albedo", "nrm": "normal"}
_KNOWN = (*_FEATURES, "ldr", "sh1", "sh1x", "sh1y", "sh1z", "shl1x", "shl1y", "shl1z", "dpt")
_REFERENCE = -1
_PLAIN = 0
_SPACE = "world space; this layout does not say, and allows view space"


@dataclass(frozen=True)
class View:
    """One image in all its versions.

    Attributes:
        number: Number of the view in its scene.
        name: Path without version, feature and extension.
        inputs: Samples per pixel of the noisy versions, ascending; 0 for a version without a number.
        reference: Version of the reference: samples per pixel, -1 for `ref`, None where there is none.
        files: (Version, feature) → file.
        metadata: Samples and exposure file, where there is one.
    """

    number: int
    name: Path
    inputs: tuple[int, ...]
    reference: int | None
    files: dict[tuple[int, str], Path]
    metadata: Path | None


def likeness(root: Path) -> float:
    """Return the fraction of EXR files below a root that are named like features of this layout."""
    if not root.is_dir():
        return 0.0
    paths = files_below(root, (".exr",), LOOK)
    known = [p for p in paths if _parts(p) is not None]
    if not any(p.name.lower().endswith(".hdr.exr") for p in known):
        return 0.0
    return len(known) / len(paths)


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, sorted by name; one frame per view and number of samples.

    Raises:
        OSError: The root does not exist.
        ValueError: No image of this layout, two references of one image, or a version without `hdr`.
    """
    root = Path(root)
    require_folder(root)
    views = _views(root)
    if not views:
        raise ValueError(
            f"{root}: no image of the layout `oidn` found, expected <name>_<spp>spp.hdr.exr with .alb.exr "
            "and .nrm.exr beside it, and <name>_ref.hdr.exr or an image with more samples as the reference"
        )
    return [
        Scene(
            name,
            tuple(range(sum(len(view.inputs) for view in members))),
            partial(read, name, folder, only),
            depth="euclidean",
            sequence=False,
            provenance=f"Open Image Denoise training set, reference {_reference_text(members)}",
        )
        for name, (folder, only, members) in sorted(views.items())
    ]


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(scene: str, folder: Path, only: str | None, index: int) -> Frame:
    """Read one noisy version of a view with the features beside it, and the reference.

    Args:
        scene: Name of the scene.
        folder: Where its images are.
        only: Name of its only image, where the folder has scenes of one image; None: all are its views.
        index: Number of the frame.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    versions = [(view, spp) for view in _members(folder, only) for spp in view.inputs]
    view, spp = versions[index]
    gathering = Gathering(f"{scene}/frame {index}")
    for feature, name in _FEATURES.items():
        path = _feature(view, spp, feature)
        if path is None:
            continue
        _take(gathering, name, path)
        if path != view.files.get((spp, feature)):
            gathering.note("assumed", name, f"{path.name} holds for {spp or 'all'} spp too")
    if view.reference is not None:
        _take(gathering, "reference", view.files[view.reference, "hdr"])
    if "normal" in gathering.buffers:
        known = gathering.notes.get("assumed", {}).get("normal", "")
        gathering.note("assumed", "normal", "; ".join(filter(None, (known, _SPACE))))
    _name_albedo(gathering)
    known_spp = view.reference if view.reference and view.reference > 0 else None
    frame = gathering.frame(scene, index, spp or None, {"view": view.number, "reference_spp": known_spp})
    return replace(frame, exposure=_exposure(view.metadata))


def _parts(path: Path) -> tuple[str, int, str] | None:
    """Return name, version and feature of a file, None for files of another kind."""
    match = _FILE.fullmatch(path.name)
    if match is None or match["feature"].lower() not in _KNOWN:
        return None
    version = (match["version"] or "").lower()
    if not version:
        return match["name"], _PLAIN, match["feature"].lower()
    digits = version.removesuffix("spp")
    number = int(digits[:18]) if digits.isdecimal() else _REFERENCE
    return match["name"], number, match["feature"].lower()


def _views(root: Path) -> dict[str, tuple[Path, str | None, tuple[View, ...]]]:
    """Return scene → its folder, its only image where it has one, and its views."""
    scenes: dict[str, tuple[Path, str | None, tuple[View, ...]]] = {}
    for folder in sorted({root, *(path.parent for path in files_below(root, (".exr",)))}):
        below = folder.relative_to(root).parts
        names: list[str | None] = [None] if below else list(_images(folder, folder.stat().st_mtime_ns))
        for only in names:
            members = _members(folder, only)
            scene = "-".join(below) if only is None else only
            if members and scene in scenes:
                raise ValueError(
                    f"{root}: both {scenes[scene][0]} and {folder} make a scene called {scene!r}"
                )
            if members:
                scenes[scene] = (folder, only, members)
    return scenes


def _members(folder: Path, only: str | None) -> tuple[View, ...]:
    images = _images(folder, folder.stat().st_mtime_ns)
    chosen = images if only is None else {only: images[only]}
    return tuple(_view(i, folder / name, files) for i, (name, files) in enumerate(chosen.items()))


@lru_cache(maxsize=64)
def _images(folder: Path, changed: int) -> dict[str, dict[tuple[int, str], Path]]:
    """Return name → (version, feature) → file of one folder, sorted by name."""
    images: dict[str, dict[tuple[int, str], Path]] = {}
    for path in sorted(folder.iterdir()):
        parts = None if path.name.startswith(".") or not path.is_file() else _parts(path)
        if parts is None:
            continue
        name, version, feature = parts
        files = images.setdefault(name, {})
        if (version, feature) in files:
            raise ValueError(f"{path} and {files[version, feature].name} are the same image; remove one")
        files[version, feature] = path
    return dict(sorted(images.items()))


def _view(number: int, name: Path, files: dict[tuple[int, str], Path]) -> View:
    colors = sorted({version for version, feature in files if feature == "hdr"})
    for version, feature in files:
        if version > 0 and version not in colors:
            file = files[version, feature]
            hint = "; low dynamic range cannot be used" if feature == "ldr" else ""
            raise ValueError(f"{file} has no .hdr.exr of as many samples beside it{hint}")
    if not colors:
        listed = ", ".join(sorted(p.name for p in files.values())[:5])
        raise ValueError(f"{name}: no .hdr.exr with the radiance; found {listed}")
    inputs = [version for version in colors if version != _REFERENCE]
    reference: int | None = _REFERENCE if _REFERENCE in colors else None
    if not inputs:
        raise ValueError(f"{name}: there is a reference, but no noisy image such as {name.name}_4spp.hdr.exr")
    if reference is None and len(inputs) > 1:
        reference = inputs.pop()
    metadata = name.parent / f"{name.name}.json"
    return View(number, name, tuple(inputs), reference, files, metadata if metadata.is_file() else None)


def _feature(view: View, spp: int, feature: str) -> Path | None:
    """Return the file of a feature: of as many samples, of no stated number, or of the reference."""
    for version in (spp, _PLAIN, view.reference):
        found = None if version is None else view.files.get((version, feature))
        if found is not None:
            return found
    return None


def _take(gathering: Gathering, name: str, path: Path) -> None:
    image = read_exr(path)
    groups = channel_groups(image.channels)
    if len(groups) > 1 and DEFAULT not in groups:
        found = ", ".join(image.channels)
        raise ValueError(f"{path}: expected the channels R, G, B (or X, Y, Z) of one feature, found {found}")
    gathering.add(name, image, groups.get(DEFAULT) or next(iter(groups.values())))


def _name_albedo(gathering: Gathering) -> None:
    """Clip the albedo as the authors' reader does, and name it by what it is."""
    raw = gathering.buffers.pop("diffuse_albedo", None)
    if raw is None:
        return
    albedo = np.minimum(raw, np.float32(1))
    number = int((albedo != raw).any(-1).sum())
    unknown = (albedo == 0).all(-1) & (gathering.buffers["color"] > 0).any(-1)
    name = "diffuse_albedo" if unknown.any() else "albedo"
    gathering.buffers[name] = albedo if unknown.any() else effective_albedo(albedo)
    for told in gathering.notes.values():
        if isinstance(told, dict) and "diffuse_albedo" in told:
            told[name] = told.pop("diffuse_albedo")
    if number:
        gathering.note("clipped", name, gathering.notes.get("clipped", {}).get(name, 0) + number)
    if name == "albedo":
        assumed = gathering.notes.get("assumed", {}).get("albedo")
        reason = "effective, since it is nowhere 0 where there is radiance"
        gathering.note("assumed", "albedo", reason if assumed is None else f"{reason}; {assumed}")


def _exposure(path: Path | None) -> float | None:
    """Return `exposure` of the JSON file that may stand beside an image."""
    if path is None:
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        exposure = values.get("exposure") if isinstance(values, dict) else None
        number = None if exposure is None else float(exposure)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if number is not None and not 0 < number < float("inf"):
        raise ValueError(f"{path}: exposure {number}, expected a positive number")
    return number


def _reference_text(views: tuple[View, ...]) -> str:
    counts = {view.reference for view in views}
    if counts == {None}:
        return "absent"
    known = sorted(c for c in counts if c is not None and c > 0)
    return (
        " to ".join(str(c) for c in dict.fromkeys((known[0], known[-1]))) + " spp" if known else "unknown spp"
    )
