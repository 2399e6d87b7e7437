"""Layout of SBMC's data sets: binary tiles with every sample and its path, in a folder per scene.

`<scene>/0000_0128.bin`, one tile per file, or a text file that lists the tiles one per line, relative to its
own folder. The tiles of a scene are parts of one image: where they cover it they are joined to one frame,
otherwise (training sets keep chosen tiles) each is a frame of its own.

`color` and the other images are means over the samples, `reference` is the converged pixel data. What
differs from this project's buffers and is said in the notes: normals are in camera space; depths are divided
by ten scene radii. `bounce` is ordered as the authors' networks take it, by flag and then by vertex.
`lens` is divided by the aperture, which `notes["camera"]` has together with focus distance, field of view and
scene radius.

Source: Gharbi et al. 2019, doi:10.1145/3306346.3322954.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.dropped import mean, mean_of_hits, mean_variance
from data.frame import Frame
from data.layouts.channels import Gathering
from data.layouts.samples import clean, means
from data.layouts.sbmc_tile import FLAGS, VERTICES, TileHeader, read_header, read_tile
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.walk import LOOK, files_below

MAX_FRAME_BYTES = 1 << 30
"""Samples of a joined frame; larger images stay tiles."""

_PLANES = {
    "offset": 2,
    "lens": 2,
    "time": 1,
    "diffuse": 3,
    "specular": 3,
    "first_normal": 3,
    "normal": 3,
    "first_depth": 1,
    "depth": 1,
    "visibility": 1,
    "hit": 1,
    "first_albedo": 3,
    "diffuse_albedo": 3,
    "path_probability": 4 * VERTICES,
    "light_direction": 2 * VERTICES,
}
_MEANS = ("diffuse", "normal", "diffuse_albedo", "visibility", "hit")
_VARIANCES = ("diffuse", "normal", "diffuse_albedo")
_SHARED = slice(0, 13)
_ASSUMED = {
    "normal": "camera space, as the authors' renderer writes it",
    "depth": "divided by ten scene radii",
}


def likeness(root: Path) -> float:
    """Return the fraction of files below a root that are tiles, by name; 1 for a list of tiles."""
    if root.is_file():
        return float(root.suffix == ".txt" and _lists_tiles(root))
    if not root.is_dir():
        return 0.0
    paths = files_below(root, most=LOOK)
    tiles = [p for p in paths if p.suffix == ".bin"]
    if not tiles or not any(_is_tile(p) for p in tiles[:8]):
        return 0.0
    return len(tiles) / len(paths)


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root, or those in a list of tiles, sorted by name.

    Raises:
        OSError: The root or a listed tile does not exist.
        ValueError: No tile, a list that leaves its folder, a header that is not plausible, or tiles of one
            scene that do not fit each other; names file and field.
    """
    root = Path(root)
    paths = _listed(root) if root.is_file() else _found(root)
    folder = root.parent if root.is_file() else root
    scenes: dict[str, list[Path]] = {}
    for path in paths:
        if path.suffix != ".bin" or not path.is_file():
            raise FileNotFoundError(f"{root} lists {path}, which is no .bin file")
        scenes.setdefault(_scene_name(folder, path), []).append(path)
    return [_scene(name, members) for name, members in sorted(scenes.items())]


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(scene: str, folder: Path, names: tuple[str, ...], index: int) -> Frame:
    """Read one frame.

    Args:
        scene: Name of the scene.
        folder: Where its tiles are.
        names: Names of the tiles that are joined; empty: every tile of the folder is a frame.
        index: Number of the frame, or of the tile in the sorted folder.

    Raises:
        OSError: A tile is missing.
        ValueError: A tile is damaged (names file and field or block), or lz4 is not installed.
    """
    if not names:
        tile = read_tile(folder / _names(folder, folder.stat().st_mtime_ns)[index])
        return _frame(scene, index, tile.header, tile.pixels, tile.samples, tile.flags)
    first = read_header(folder / names[0])
    size = (first.image_height, first.image_width)
    pixels = np.empty((first.pixel_features, *size), np.float32)
    samples = np.empty((first.sample_count, sum(_PLANES.values()), *size), np.float32)
    flags = np.empty((first.sample_count, VERTICES, *size), np.int16)
    for name in names:
        tile = read_tile(folder / name)
        _check_alike(folder / name, tile.header, first, folder / names[0])
        place = _place(tile.header)
        pixels[:, *place], samples[..., *place], flags[..., *place] = tile.pixels, tile.samples, tile.flags
    return _frame(scene, index, first, pixels, samples, flags)


def _found(root: Path) -> list[Path]:
    require_folder(root)
    paths = [p for p in files_below(root, (".bin",)) if p.suffix == ".bin"]
    if not paths:
        raise ValueError(
            f"{root}: no tile of the layout `sbmc` found, expected <scene>/*.bin, or a .txt file that lists "
            "such tiles"
        )
    return paths


def _listed(root: Path) -> list[Path]:
    if root.suffix != ".txt":
        raise ValueError(f"{root} is a file, expected a folder of scenes or a .txt list of tiles")
    lines = [line.strip() for line in root.read_text(encoding="utf-8", errors="replace").splitlines()]
    entries = [PurePosixPath(line.replace("\\", "/")) for line in lines if line]
    if not entries:
        raise ValueError(f"{root} lists no tiles")
    for entry in entries:
        if entry.is_absolute() or ".." in entry.parts:
            raise ValueError(f"{root}: {entry} is outside the list's folder, expected paths below it")
    return sorted({root.parent / entry for entry in entries})


def _lists_tiles(root: Path) -> bool:
    try:
        with root.open(encoding="utf-8", errors="replace") as file:
            return file.readline(4096).strip().endswith(".bin")
    except OSError:
        return False


def _is_tile(path: Path) -> bool:
    try:
        read_header(path)
    except (OSError, ValueError):
        return False
    return True


def _scene_name(folder: Path, path: Path) -> str:
    below = path.parent.relative_to(folder).parts
    return "-".join(below) if below else folder.resolve().name


def _scene(name: str, paths: list[Path]) -> Scene:
    headers = {path: read_header(path) for path in paths}
    first = headers[paths[0]]
    for path, header in headers.items():
        _check_alike(path, header, first, paths[0])
    folder = paths[0].parent
    whole = _complete(headers)
    names = tuple(path.name for path in paths)
    numbers = {tile: i for i, tile in enumerate(_names(folder, folder.stat().st_mtime_ns))}
    return Scene(
        name,
        (0,) if whole else tuple(numbers[tile] for tile in names),
        partial(read, name, folder, names if whole else ()),
        depth="euclidean",
        sequence=False,
        provenance=f"SBMC data set (doi:10.1145/3306346.3322954), {first.sample_count} spp, "
        f"reference {first.gt_sample_count} spp",
    )


@lru_cache(maxsize=64)
def _names(folder: Path, changed: int) -> tuple[str, ...]:
    return tuple(sorted(p.name for p in folder.iterdir() if p.suffix == ".bin"))


def _check_alike(path: Path, header: TileHeader, first: TileHeader, other: Path) -> None:
    names = list(TileHeader.__dataclass_fields__)
    for name, value, expected in zip(
        names[_SHARED], astuple(header)[_SHARED], astuple(first)[_SHARED], strict=True
    ):
        if value != expected:
            raise ValueError(f"{path}: {name} is {value}, but {expected} in {other.name} of the same scene")
    size = header.tile_size
    if header.block_x + size > header.image_width or header.block_y + size > header.image_height:
        raise ValueError(
            f"{path}: the tile of {size} pixels at block_x {header.block_x}, block_y {header.block_y} is not "
            f"inside its image of {header.image_width}x{header.image_height}"
        )


def _complete(headers: dict[Path, TileHeader]) -> bool:
    """Return whether tiles cover their image once and exactly, and the frame fits memory."""
    covered: dict[tuple[int, int], Path] = {}
    for path, header in headers.items():
        block = (header.block_x, header.block_y)
        if block in covered:
            raise ValueError(f"{path}: block_x, block_y {block} is also in {covered[block].name}")
        covered[block] = path
    first = next(iter(headers.values()))
    size, area = first.tile_size, first.image_width * first.image_height
    aligned = all(x % size == 0 and y % size == 0 for x, y in covered)
    if not aligned or len(headers) * size * size != area:
        return False
    return first.sample_count * (sum(_PLANES.values()) + FLAGS * VERTICES) * 4 * area <= MAX_FRAME_BYTES


def _place(header: TileHeader) -> tuple[slice, slice]:
    size = header.tile_size
    return slice(header.block_y, header.block_y + size), slice(header.block_x, header.block_x + size)


def _frame(
    scene: str,
    index: int,
    header: TileHeader,
    pixels: NDArray[np.float32],
    samples: NDArray[np.float32],
    flags: NDArray[np.int16],
) -> Frame:
    notes: dict[str, Any] = {"assumed": dict(_ASSUMED), "normalised": ["depth", "first_depth"]}
    kept = clean(_parts(header, samples, flags), notes)
    gathering = Gathering(f"{scene}/frame {index}", notes=notes)
    buffers = {"color": mean(kept.get("radiance")), **means(kept, _MEANS)}
    buffers["depth"] = mean_of_hits(kept.get("depth"))
    if kept.count > 1:
        buffers["color_variance"] = mean_variance(kept.get("radiance"))
        buffers |= {f"{name}_variance": mean_variance(kept.get(name)) for name in _VARIANCES}
    plain = np.moveaxis(pixels, 0, -1)
    buffers["reference"] = plain[..., 0:3] + plain[..., 3:6]
    buffers["reference_diffuse"] = np.ascontiguousarray(plain[..., 0:3])
    for name, image in buffers.items():
        gathering.put(name, image, f"{scene}/frame {index}")
    camera = {k: getattr(header, k) for k in ("focus_distance", "aperture_radius", "fov", "scene_radius")}
    told = {
        "camera": camera,
        "block": [header.block_x, header.block_y],
        "reference_spp": header.gt_sample_count or None,
    }
    frame = gathering.frame(scene, index, header.sample_count, told)
    frame.samples = kept
    frame.thin_lens = (header.aperture_radius, header.focus_distance, header.fov)
    frame.validate()
    return frame


def _parts(
    header: TileHeader, samples: NDArray[np.float32], flags: NDArray[np.int16]
) -> dict[str, NDArray[np.float32]]:
    """Return quantity → (S, H, W, c) in the order of the vocabulary's channels."""
    ends = np.cumsum(list(_PLANES.values())).tolist()
    parts = {
        name: np.ascontiguousarray(np.moveaxis(samples[:, end - count : end], 1, -1))
        for (name, count), end in zip(_PLANES.items(), ends, strict=True)
    }
    # A miss has depth -1 before the division by the scene's radius.
    missed = parts["hit"] == 0
    for name in ("depth", "first_depth"):
        parts[name][missed | (parts[name] < 0)] = 0
    if header.aperture_radius > 0:
        parts["lens"] /= np.float32(header.aperture_radius)
    bits = [(flags >> bit) & 1 for bit in range(FLAGS)]
    parts["bounce"] = np.moveaxis(np.concatenate(bits, 1), 1, -1).astype(np.float32)
    radiance = parts["diffuse"] + parts["specular"]
    return {"radiance": radiance, **parts}
