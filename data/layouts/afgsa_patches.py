"""Built patches of AFGSA: `train.h5`, `val.h5` and `test_<spp>.h5`, one scene per file.

Data sets `noisy`, `gt`, `spec`, `diff`, `spec_gt`, `diff_gt` (N, 128, 128, 3) and `aux` (N, 128, 128, 7): the
normal as rendered, the depth divided by the largest of its picture, the albedo. Only `noisy`, `gt` and `aux`
have to be there; `spec_gt` is `gt` less `diff_gt` and not read. Where a patch comes from is not recorded, so
that patches of one picture cannot be kept together: use the files as they are split.
"""

from __future__ import annotations

import re
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.frame import Frame
from data.layouts.channels import Gathering, missing_buffer
from data.layouts.hdf5 import dataset, items, names, open_hdf5
from data.layouts.scene import Scene

COLORS = {
    "noisy": "color",
    "gt": "reference",
    "spec": "specular",
    "diff": "diffuse",
    "diff_gt": "reference_diffuse",
}
AUX = {"normal": slice(0, 3), "depth": slice(3, 4), "diffuse_albedo": slice(4, 7)}
SPP, REFERENCE_SPP = 32, 32768

_FILE = re.compile(r"(?:train|val|test_(?P<spp>\d+))\.h5")
_BLOCK_BYTES = 1 << 25


def files(root: Path) -> list[Path]:
    """Return the files of patches in a folder: training, validation, tests by samples per pixel."""
    found = [(m["spp"], p) for p in root.iterdir() if (m := _FILE.fullmatch(p.name))]
    return [p for _, p in sorted(found, key=lambda pair: (int(pair[0] or 0), pair[1].name))]


def scenes(root: Path) -> list[Scene]:
    """Return one scene per file, its patches as views.

    Raises:
        ValueError: h5py is not installed, or a file is damaged, unsafe or incomplete.
    """
    return [_scene(root, path) for path in files(root)]


def read(path: Path, index: int) -> Frame:
    """Read one patch; neighbours are read along with it and kept for the next call.

    Raises:
        ValueError: The file is damaged or has no such patch.
    """
    scene = path.stem
    gathering = Gathering(f"{scene}/frame {index}")
    changed = path.stat().st_mtime_ns
    present, rows = _layout_of(path, changed)
    first = index // rows * rows
    for key in present:
        patch = _block(path, changed, key, first, rows)[index - first]
        where = f"{path}: data set {key!r}, item {index}"
        if key != "aux":
            gathering.put(COLORS[key], patch, where)
            continue
        for name, channels in AUX.items():
            gathering.put(name, np.ascontiguousarray(patch[..., channels]), where)
    reference_spp = None if scene.startswith("test") else REFERENCE_SPP
    notes = {
        "normalised": ["depth"],
        "view": index,
        "reference_spp": reference_spp,
        "channels": {name: [key] for key, name in COLORS.items() if key in present}
        | {name: [f"aux {c.start} to {c.stop - 1}"] for name, c in AUX.items()},
    }
    return gathering.frame(scene, index, _spp(path), notes)


def _scene(root: Path, path: Path) -> Scene:
    with open_hdf5(path) as file:
        present = names(file)
        for key in ("noisy", "gt", "aux"):
            if key not in present:
                buffers = COLORS.get(key, "normal, depth and albedo")
                raise missing_buffer("afgsa", path, f"data set {key!r} ({buffers})", present, root)
        shape = dataset(file, "noisy", 4, 3).shape
        for key in (*COLORS, "aux"):
            if key in present:
                found = dataset(file, key, 4, 7 if key == "aux" else 3)
                if found.shape[:3] != shape[:3]:
                    raise ValueError(f"{path}: data set {key!r} is {found.shape}, but 'noisy' is {shape}")
    reference = "unknown" if path.stem.startswith("test") else str(REFERENCE_SPP)
    return Scene(
        path.stem,
        tuple(range(shape[0])),
        partial(read, path),
        depth="euclidean",
        sequence=False,
        credit="Xu et al. and Yu et al., ACFM and AFGSA data sets",
        provenance="AFGSA patches (doi:10.1145/3478513.3480565), Tungsten, "
        f"{_spp(path)} spp, reference {reference} spp; depth divided by the largest of its picture",
    )


def _spp(path: Path) -> int:
    match = _FILE.fullmatch(path.name)
    return int(match["spp"]) if match and match["spp"] else SPP


@lru_cache(maxsize=16)
def _layout_of(path: Path, changed: int) -> tuple[tuple[str, ...], int]:
    """Return the data sets that are read, and how many items lie in one chunk and are read at once."""
    with open_hdf5(path) as file:
        present = tuple(key for key in (*COLORS, "aux") if key in names(file))
        aux = dataset(file, "aux", 4, 7)
        item = 4 * int(np.prod(aux.shape[1:]))
        rows = max((dataset(file, key, 4).chunks or (1,))[0] for key in present)
        return present, max(1, min(rows, _BLOCK_BYTES // item, aux.shape[0]))


@lru_cache(maxsize=8)
def _block(path: Path, changed: int, key: str, first: int, rows: int) -> NDArray[np.float32]:
    with open_hdf5(path) as file:
        source = dataset(file, key, 4, 7 if key == "aux" else 3)
        return items(source, first, min(first + rows, source.shape[0]))
