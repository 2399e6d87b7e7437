"""Layout of AFGSA: Tungsten renders in three arrangements.

- Folders of frames: `32spp/<scene>_<shot>_32_{color,diffuse,specular,normal,depth,albedo}.exr` and
  `32768spp/<scene>_<shot>_32768_{color,diffuse,specular}.exr`.
- Built patches: `train.h5`, `val.h5`, `test_<spp>.h5`; see `data.layouts.afgsa_patches`.
- Inference: `<name>.exr` with the groups default, normal, depth, albedo, and `<name>_gt.exr`; see
  `data.layouts.merged`.

One root has one of them, since patches cut from the frames beside them would be in the set twice.

Source: Yu et al. 2021, doi:10.1145/3478513.3480565.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path

from data.frame import Frame
from data.layouts import afgsa_patches as patches
from data.layouts import merged
from data.layouts.channels import missing_buffer
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.siblings import View, read_siblings, reference_parts, require_files

ROLES = {
    "color": "color",
    "diffuse": "diffuse",
    "specular": "specular",
    "normal": "normal",
    "depth": "depth",
    "albedo": "diffuse_albedo",
}
NEEDED = ("color", "normal", "depth", "diffuse_albedo")
CREDIT = "Xu et al. and Yu et al., ACFM and AFGSA data sets"

_FOLDER = re.compile(r"(\d+)spp")
_FILE = re.compile(rf"(?P<scene>.+)_(?P<shot>[^_]+)_(?P<spp>\d+)_(?P<role>{'|'.join(ROLES)})\.exr")


def likeness(root: Path) -> float:
    """Return 1 for folders of frames or built patches, less for merged files, which others have too."""
    if not root.is_dir():
        return 0.0
    if patches.files(root) or any(
        _FILE.fullmatch(p.name) for f in _levels(root).values() for p in f.iterdir()
    ):
        return 1.0
    wanted, foreign = {"default", "normal", "depth", "albedo"}, {"diffuse", "specular"}
    return 0.9 * merged.share(_merged(root), wanted, foreign)


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root; built patches are the scenes `train`, `val`, `test_<spp>`.

    Raises:
        OSError: The root does not exist.
        ValueError: No such files, several arrangements at once, a file without its counterpart, or a buffer
            that is missing and cannot be derived.
    """
    root = Path(root)
    require_folder(root)
    found = {
        "folders of frames": _shots(root),
        "built patches": patches.files(root),
        "merged files": _merged(root),
    }
    kinds = [kind for kind, content in found.items() if content]
    if not kinds:
        raise ValueError(
            f"{root}: nothing of the layout `afgsa` found, expected 32spp/<scene>_<shot>_32_color.exr and "
            "32768spp/…, or train.h5, val.h5, test_<spp>.h5, or <name>.exr and <name>_gt.exr"
        )
    if len(kinds) > 1:
        raise ValueError(f"{root} holds {' and '.join(kinds)}; name the folder of one of them")
    if found["folders of frames"]:
        return _scenes(root)
    return patches.scenes(root) if found["built patches"] else _inference(root)


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(root: Path, scene: str, index: int) -> Frame:
    """Read one frame of the folders of frames.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    return read_siblings(_shots(root)[scene][index], NEEDED, scene, index)


def _merged(root: Path) -> list[merged.MergedView]:
    return [view for view in merged.views(root) if view.noisy.parent == root]


def _inference(root: Path) -> list[Scene]:
    return merged.scenes("afgsa", root, NEEDED, CREDIT, "AFGSA inference files, Tungsten")


def _scenes(root: Path) -> list[Scene]:
    scenes = []
    for name, views in sorted(_shots(root).items()):
        for view in views:
            if not view.noisy:
                raise missing_buffer(
                    "afgsa",
                    root,
                    f"buffer 'color' ({view.name} has a reference only)",
                    [path.name for path in view.reference.values()],
                    root,
                )
            require_files("afgsa", view, NEEDED, root, {"diffuse_albedo": "albedo"})
            if not view.reference and any(v.reference for v in views):
                told = f"buffer 'reference' (color.exr of {view.name} at the highest number of samples)"
                raise missing_buffer("afgsa", root, told, [p.name for p in view.noisy.values()], root)
        spp = ", ".join(str(s) for s in sorted({v.spp or 0 for v in views}))
        reference = max(v.reference_spp or 0 for v in views) or "unknown"
        scenes.append(
            Scene(
                name,
                tuple(range(len(views))),
                partial(read, root, name),
                depth="euclidean",
                sequence=False,
                credit=CREDIT,
                provenance=f"ACFM data set in AFGSA's arrangement (doi:10.1145/3478513.3480565), Tungsten, "
                f"{spp} spp, reference {reference} spp",
            )
        )
    return scenes


def _levels(root: Path) -> dict[int, Path]:
    """Return samples per pixel → folder, ascending."""
    found = {int(m[1]): p for p in root.iterdir() if p.is_dir() and (m := _FOLDER.fullmatch(p.name))}
    return dict(sorted(found.items()))


def _shots(root: Path) -> dict[str, tuple[View, ...]]:
    levels = _levels(root)
    return _listed(root, tuple(f.stat().st_mtime_ns for f in levels.values()))


@lru_cache(maxsize=16)
def _listed(root: Path, changed: tuple[int, ...]) -> dict[str, tuple[View, ...]]:
    levels = _levels(root)
    last = max(levels) if len(levels) > 1 else None
    shots: dict[str, dict[str, dict[int, dict[str, Path]]]] = {}
    for spp, folder in levels.items():
        for path in sorted(folder.iterdir()):
            match = _FILE.fullmatch(path.name)
            if match and int(match["spp"]) == spp:
                shot = shots.setdefault(match["scene"], {}).setdefault(match["shot"], {})
                shot.setdefault(spp, {})[match["role"]] = path
    result = {}
    for scene, numbered in shots.items():
        views = [
            _view(f"{scene}_{shot}", number, found, last)
            for number, (shot, found) in enumerate(sorted(numbered.items()))
        ]
        result[scene] = tuple(view for several in views for view in several)
    return result


def _view(name: str, number: int, found: dict[int, dict[str, Path]], last: int | None) -> list[View]:
    converged = found.get(last, {}) if last is not None else {}
    reference = {role: converged[role] for role in reference_parts(converged)}
    ignored = tuple(sorted(p.name for p in converged.values() if p not in reference.values()))
    levels: list[int | None] = [spp for spp in sorted(found) if spp != last]
    views = []
    for spp in levels or [None]:
        noisy = {} if spp is None else {ROLES[r]: found[spp][r] for r in ROLES if r in found[spp]}
        views.append(View(name, number, noisy, reference, spp, last if reference else None, ignored))
    return views
