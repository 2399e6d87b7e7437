"""Output of the Tungsten renderer: each buffer in an EXR file of its own, halves and variances beside it.

`<scene>/color.exr`, `albedo.exr`, `normal.exr`, `depth.exr`, `visibility.exr`, `diffuse.exr`,
`specular.exr` as the scene file's list of outputs names them; with `two_buffer_variance` also `colorA.exr`,
`colorB.exr`, with `sample_variance` `colorVariance.exr` (variance of the mean). A number before the suffix
is the frame of a sequence: `color12.exr`, `color12A.exr`, `color12Variance.exr`. `reference.exr`, `gt.exr`
or `target.exr` (with the number) is the reference. `TungstenRender.exr`, the name that the renderer uses by
default, is the color where no other is there. Samples per pixel are taken from a scene file (JSON) in the
folder, which may say `renderer.spp`; it may be another run's, so the records say where they are from.

Source: Bitterli, the Tungsten renderer; Bitterli et al. 2016, doi:10.1111/cgf.12954, for halves and
variances.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path

from data.buffers import BUFFERS
from data.frame import Frame
from data.layouts.channels import REFERENCE_WORDS, missing_buffer
from data.layouts.scene import Scene, all_frames, require_folder, subfolders
from data.layouts.siblings import View, absent, read_siblings, require_files

OUTPUTS = {
    "color": "color",
    "albedo": "diffuse_albedo",
    "normal": "normal",
    "depth": "depth",
    "visibility": "visibility",
    "diffuse": "diffuse",
    "specular": "specular",
}
NEEDED = ("color",)
DEFAULT_OUTPUT = "TungstenRender.exr"

_PARTS = {"A": "_a", "B": "_b", "Variance": "_variance", "": ""}
_FILE = re.compile(rf"(?P<output>{'|'.join(OUTPUTS)})(?P<number>\d*)(?P<part>A|B|Variance|)\.exr")
_REFERENCE = re.compile(rf"(?:{'|'.join(REFERENCE_WORDS)})(?P<number>\d*)\.exr")
_MAX_SCENE_FILE = 1 << 24


def likeness(root: Path) -> float:
    """Return the fraction of folders with outputs of the renderer, 0 for those of BMFR's kind."""
    if not root.is_dir():
        return 0.0
    folders = _folders(root)
    return sum(_looks_like(f) for f in folders) / len(folders) if folders else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, or the root itself where it is one scene, sorted by name.

    Raises:
        OSError: The root does not exist.
        ValueError: No output of the renderer, or a buffer of some frame is missing that others have.
    """
    root = Path(root)
    require_folder(root)
    scenes = [_scene(root, folder) for folder in _folders(root) if _views(folder)]
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `tungsten` found, expected <scene>/color.exr with albedo.exr, "
            "normal.exr, depth.exr beside it, and colorA.exr, colorB.exr, colorVariance.exr where written"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(folder: Path, scene: str, index: int) -> Frame:
    """Read one frame; buffers of which only the halves are there become their mean.

    Raises:
        OSError: A file is missing.
        ValueError: A file is damaged or has another size; the message names it.
    """
    view = next((v for v in _views(folder) if v.number == index), None)
    if view is None:
        raise ValueError(f"{folder}: there is no frame {index} in it any more")
    halved = [name.removesuffix("_a") for name in view.noisy if name.endswith("_a")]
    wanted = [n for n in halved if not absent([n], view.noisy)]
    frame = read_siblings(view, (*NEEDED, *wanted), scene, index)
    if view.spp is not None:
        frame.notes["assumed"] = {"spp": f"{view.spp}, from the scene file"}
    return frame


def _folders(root: Path) -> list[Path]:
    if _views(root):
        return [root]
    return subfolders(root)


def _looks_like(folder: Path) -> bool:
    names = [p.name for p in folder.iterdir()]
    if any(n.startswith(("shading_normal", "world_position")) for n in names):
        return False
    outputs = {m["output"] + m["part"] for n in names if (m := _FILE.fullmatch(n))}
    return (bool(outputs & {"color", "colorA", "diffuse"}) and len(outputs) > 1) or DEFAULT_OUTPUT in names


def _scene(root: Path, folder: Path) -> Scene:
    views = _views(folder)
    everything = dict.fromkeys(name for view in views for name in view.noisy)
    for view in views:
        found = sorted(path.name for path in (*view.noisy.values(), *view.reference.values()))
        require_files("tungsten", view, NEEDED, root, {})
        for name in absent(everything, view.noisy):
            raise missing_buffer(
                "tungsten", folder, f"buffer {name!r} of {view.name}, which other frames have", found, root
            )
        if not view.reference and any(v.reference for v in views):
            told = f"buffer 'reference' of {view.name}, which other frames have"
            raise missing_buffer("tungsten", folder, told, found, root)
    numbers = [view.number for view in views]
    return Scene(
        folder.resolve().name,
        tuple(numbers),
        partial(read, folder, folder.resolve().name),
        depth="euclidean",
        sequence=len(numbers) > 1 and numbers == list(range(numbers[0], numbers[-1] + 1)),
        provenance=f"Tungsten, {views[0].spp or 'unknown'} spp",
    )


def _views(folder: Path) -> tuple[View, ...]:
    return _listed(folder, folder.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _listed(folder: Path, changed: int) -> tuple[View, ...]:
    noisy: dict[int, dict[str, Path]] = {}
    references: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match, reference = _FILE.fullmatch(path.name), _REFERENCE.fullmatch(path.name)
        if match:
            name = OUTPUTS[match["output"]] + _PARTS[match["part"]]
            if name in BUFFERS:
                noisy.setdefault(int(match["number"] or 0), {})[name] = path
        elif reference:
            references[int(reference["number"] or 0)] = path
    default = folder / DEFAULT_OUTPUT
    if default.is_file() and set(noisy) <= {0} and absent(["color"], noisy.get(0, {})):
        noisy.setdefault(0, {})["color"] = default
    spp = _spp(folder)
    return tuple(
        View(
            f"frame {number}",
            number,
            noisy[number],
            {"color": references[number]} if number in references else {},
            spp,
        )
        for number in sorted(noisy)
    )


def _spp(folder: Path) -> int | None:
    """Return the samples per pixel of the only scene file, None where there is none or it does not say."""
    found = [p for p in folder.glob("*.json") if p.stat().st_size <= _MAX_SCENE_FILE]
    if len(found) != 1:
        return None
    try:
        spp = json.loads(found[0].read_text(encoding="utf-8"))["renderer"]["spp"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return spp if isinstance(spp, int) and spp > 0 else None
