"""Layout of ACFM's data set: crops of Tungsten renders, one EXR file per buffer.

Training: `<scene>/<crop>-00032spp_{normal,depth,texture,diffuse,specular,visibility,variance,color}.exr` and
`<scene>/<crop>-32768spp_{diffuse,specular,texture,color}.exr`; any other numbers of samples are read as well,
the highest one is the reference. Test: `<scene>_<spp>_{normal,depth,albedo,diffuse,specular}.exr` in one
folder, with `<scene>.exr` as the reference where it is there. The albedo is called `texture` in one and
`albedo` in the other; both are what the renderer wrote, 0 on lights and background.

The authors' loader replaces a missing file by zeros without a word; here it is an error, unless the buffer
follows from others (color = diffuse + specular). It also cuts 128 pixels at (1, 1) from each crop; here crops
stay whole. The albedo of the reference is not read, nor its specular part, which is color less diffuse.

Source: Xu et al. 2019, doi:10.1145/3355089.3356547.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path

from data.frame import Frame
from data.layouts.channels import missing_buffer
from data.layouts.scene import Scene, all_frames, require_folder, subfolders
from data.layouts.siblings import View, read_siblings, reference_parts, require_files

ROLES = {
    "color": "color",
    "diffuse": "diffuse",
    "specular": "specular",
    "normal": "normal",
    "depth": "depth",
    "texture": "diffuse_albedo",
    "albedo": "diffuse_albedo",
    "visibility": "visibility",
    "variance": "color_variance",
}
NEEDED = ("color", "diffuse", "specular", "normal", "depth", "diffuse_albedo")

_WORDS = "|".join(ROLES)
_CROP = re.compile(rf"(?P<name>.+)-(?P<spp>\d+)spp_(?P<role>{_WORDS})\.exr")
_TEST = re.compile(rf"(?P<name>[^_]+)_(?P<spp>\d+)_(?P<role>{_WORDS})\.exr")


def likeness(root: Path) -> float:
    """Return the fraction of EXR files that are called as in this layout."""
    if not root.is_dir():
        return 0.0
    folders = [root, *subfolders(root)]
    names = [path.name for folder in folders for path in folder.glob("*.exr")]
    crops = sum(_CROP.fullmatch(n) is not None for n in names)
    tests = [m for n in names if (m := _TEST.fullmatch(n))]
    split = {m["role"] for m in tests} >= {"diffuse", "specular"}
    return (crops + (len(tests) if split else 0)) / len(names) if names else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root: folders of crops, or the scenes of a test folder.

    Raises:
        OSError: The root does not exist.
        ValueError: No such files, or a buffer is missing and cannot be derived; the message names its file.
    """
    root = Path(root)
    require_folder(root)
    scenes = [_training(root, folder) for folder in (root, *subfolders(root)) if _crops(folder)]
    scenes += [_test(root, name) for name in sorted({m["name"] for _, m in _matches(root, _TEST)})]
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `acfm` found, expected <scene>/<crop>-00032spp_diffuse.exr with "
            "its siblings normal, depth, texture, specular, or <scene>_<spp>_diffuse.exr"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(folder: Path, test: str | None, scene: str, index: int) -> Frame:
    """Read one frame.

    Args:
        folder: Where its files lie.
        test: Name of a test scene, None for crops.
        scene: Name of the scene.
        index: Number of the frame.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    view = (_crops(folder) if test is None else _tests(folder, test))[index]
    return read_siblings(view, NEEDED, scene, index)


def _training(root: Path, folder: Path) -> Scene:
    views = _crops(folder)
    for view in views:
        require_files("acfm", view, NEEDED, root, {"diffuse_albedo": "texture"})
        if not view.reference and any(v.reference for v in views):
            found = [path.name for path in view.noisy.values()]
            told = f"buffer 'reference' (color.exr of {view.name}, or diffuse and specular)"
            raise missing_buffer("acfm", folder, told, found, root)
    name = folder.resolve().name
    return _scene(name, len(views), partial(read, folder, None, name), views)


def _test(root: Path, name: str) -> Scene:
    views = _tests(root, name)
    for view in views:
        require_files("acfm", view, NEEDED, root, {"diffuse_albedo": "albedo"})
    return _scene(name, len(views), partial(read, root, name, name), views)


def _scene(name: str, count: int, reader: partial[Frame], views: tuple[View, ...]) -> Scene:
    spp = sorted({str(v.spp) for v in views}, key=int)
    reference = sorted({str(v.reference_spp) for v in views if v.reference_spp}, key=int)
    return Scene(
        name,
        tuple(range(count)),
        reader,
        depth="euclidean",
        sequence=False,
        credit="Xu et al., ACFM data set",
        provenance=f"ACFM data set (doi:10.1145/3355089.3356547), Tungsten, {', '.join(spp)} spp, reference "
        f"{', '.join(reference) or 'unknown'} spp",
    )


def _crops(folder: Path) -> tuple[View, ...]:
    return _crop_views(folder, folder.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _crop_views(folder: Path, changed: int) -> tuple[View, ...]:
    crops: dict[str, dict[int, dict[str, Path]]] = {}
    for path, match in _matches(folder, _CROP):
        roles = crops.setdefault(match["name"], {}).setdefault(int(match["spp"]), {})
        roles[match["role"]] = path
    views = []
    for number, name in enumerate(sorted(crops)):
        levels = sorted(crops[name])
        last = levels.pop() if len(levels) > 1 else None
        converged = {} if last is None else crops[name][last]
        views += [_view(name, number, crops[name][spp], (spp, last), converged) for spp in levels]
    return tuple(views)


@lru_cache(maxsize=256)
def _test_views(folder: Path, changed: int, name: str) -> tuple[View, ...]:
    levels: dict[int, dict[str, Path]] = {}
    for path, match in _matches(folder, _TEST):
        if match["name"] == name:
            levels.setdefault(int(match["spp"]), {})[match["role"]] = path
    reference = folder / f"{name}.exr"
    converged = {"color": reference} if reference.is_file() else {}
    return tuple(_view(f"{name}_{spp}", 0, levels[spp], (spp, None), converged) for spp in sorted(levels))


def _tests(folder: Path, name: str) -> tuple[View, ...]:
    return _test_views(folder, folder.stat().st_mtime_ns, name)


def _view(
    name: str, number: int, roles: dict[str, Path], spp: tuple[int, int | None], converged: dict[str, Path]
) -> View:
    noisy = {ROLES[role]: roles[role] for role in ROLES if role in roles and role != "albedo"}
    noisy |= {} if "texture" in roles or "albedo" not in roles else {"diffuse_albedo": roles["albedo"]}
    reference = {role: converged[role] for role in reference_parts(converged)}
    ignored = [p.name for p in converged.values() if p not in reference.values()]
    return View(name, number, noisy, reference, *spp, tuple(sorted(ignored)))


def _matches(folder: Path, pattern: re.Pattern[str]) -> list[tuple[Path, re.Match[str]]]:
    return [(path, match) for path in sorted(folder.iterdir()) if (match := pattern.fullmatch(path.name))]
