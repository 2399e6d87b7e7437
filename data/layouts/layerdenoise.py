"""Layout of the layer embedding paper: HDF5 with every sample, `<name>_input.h5` and `<name>_ref.h5`.

The input (also `<name>_in.h5`) has float16 data sets [frame, sample, channel, y, x]: `color` 3,
`normals_depth` 4, `albedo` 3, `specular` 4 (colour and roughness), `uvt` 3 (lens position and time) and
`motionvecs` 3 (motion and circle of confusion). The reference has `color` as [frame, channel, y, x], or as
one sample. Each pair of files is a scene of independent frames.

What differs from this project's buffers and is said in the notes: normals are in view space, depth is
normalised. The authors' motion vectors are in normalised device coordinates and their circle of confusion is
a radius; both become pixels here, the former times half the image, the latter times two, with the direction
of y as it is stored.

Source: Munkberg and Hasselgren 2020, doi:10.1111/cgf.14049; channels and units as in the authors' reader.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from data.dropped import mean, mean_of_hits, mean_variance
from data.exr_image import HALF_MAX
from data.frame import Frame, Image
from data.layouts.channels import Gathering, missing_buffer
from data.layouts.hdf5 import dataset, items, names, open_hdf5
from data.layouts.samples import clean, means
from data.layouts.scene import Scene, all_frames, require_folder
from data.layouts.walk import LOOK, files_below

if TYPE_CHECKING:
    import h5py

_INPUT = re.compile(r"(?P<name>.+)_(?:input|in)\.(?:h5|hdf5)")
_REFERENCES = ("ref", "reference", "gt", "target")
_CHANNELS = {"color": 3, "normals_depth": 4, "albedo": 3, "specular": 4, "uvt": 3, "motionvecs": 3}
_MADE_OF = {
    "color": "radiance",
    "normals_depth": "normal and depth",
    "albedo": "diffuse_albedo",
    "specular": "specular_albedo and roughness",
    "uvt": "lens and time",
    "motionvecs": "motion and coc",
}
_MEANS = ("normal", "diffuse_albedo", "specular_albedo", "roughness")
_ASSUMED = {
    "normal": "view space, as the authors' renderer writes it",
    "depth": "normalised; the divisor is not in the files",
    "motion": "normalised device coordinates times half the image's size, y as stored",
    "coc": "the stored radius times 2, taken for pixels",
}
_ENDINGS = (".h5", ".hdf5")


def likeness(root: Path) -> float:
    """Return the fraction of HDF5 files below a root that are inputs or references by name."""
    if not root.is_dir():
        return 0.0
    paths = files_below(root, _ENDINGS, LOOK)
    inputs = [p for p in paths if _INPUT.fullmatch(p.name)]
    known = set(inputs) | {r for p in inputs if (r := _reference(p)) is not None}
    return len(known) / len(paths) if paths else 0.0


def describe(root: str | Path) -> list[Scene]:
    """Return one scene per pair of files below a root, sorted by name.

    Raises:
        OSError: The root does not exist.
        ValueError: h5py is not installed, no input file, a data set that is missing, hostile or of another
            shape, or a reference that does not fit; names file and data set.
    """
    root = Path(root)
    require_folder(root)
    inputs = [p for p in files_below(root, _ENDINGS) if _INPUT.fullmatch(p.name)]
    if not inputs:
        raise ValueError(
            f"{root}: no file of the layout `layerdenoise` found, expected <name>_input.h5 (or <name>_in.h5) "
            "and <name>_ref.h5"
        )
    return [_scene(root, path) for path in inputs]


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))


def read(scene: str, path: Path, reference: Path | None, index: int) -> Frame:
    """Read one frame, and nothing else, from its files.

    Raises:
        OSError: A file is missing.
        ValueError: h5py is not installed, or a data set is missing, hostile, damaged or of another shape.
    """
    with open_hdf5(path) as file:
        raw = {name: _last(items(_input(file, path, name), index)) for name in _CHANNELS}
    notes: dict[str, Any] = {"assumed": dict(_ASSUMED), "normalised": ["depth"]}
    raw["color"] = _radiance(raw["color"])
    kept = clean(_parts(raw), notes)
    gathering = Gathering(f"{scene}/frame {index}", notes=notes)
    buffers = {"color": mean(kept.get("radiance")), **means(kept, _MEANS)}
    buffers["depth"] = mean_of_hits(kept.get("depth"))
    if kept.count > 1:
        buffers["color_variance"] = mean_variance(kept.get("radiance"))
    for name, image in buffers.items():
        gathering.put(name, image, str(path))
    if reference is not None:
        with open_hdf5(reference) as file:
            gathering.put("reference", _target(file, reference, index), str(reference))
    frame = gathering.frame(scene, index, kept.count, {"view": index})
    frame.samples = kept
    frame.validate()
    return frame


def _scene(root: Path, path: Path) -> Scene:
    match = _INPUT.fullmatch(path.name)
    assert match is not None
    with open_hdf5(path) as file:
        found = names(file)
        for name in _CHANNELS:
            if name not in found:
                wanted = f"{name!r} ({_MADE_OF[name]})"
                raise missing_buffer("layerdenoise", path, wanted, found, root)
        shape = _input(file, path, "color").shape
        for name in _CHANNELS:
            other = _input(file, path, name).shape
            if other[:2] + other[3:] != shape[:2] + shape[3:]:
                raise ValueError(f"{path}: data set {name!r} has the shape {other}, but 'color' has {shape}")
    reference = _reference(path)
    if reference is not None:
        _check_reference(reference, path, shape)
    name = "-".join((*path.parent.relative_to(root).parts, match["name"]))
    return Scene(
        name,
        tuple(range(shape[0])),
        partial(read, name, path, reference),
        depth="euclidean",
        sequence=False,
        provenance=f"Layer embedding data set (doi:10.1111/cgf.14049), {shape[1]} spp, reference not stated",
    )


def _check_reference(reference: Path, path: Path, shape: tuple[int, ...]) -> None:
    with open_hdf5(reference) as file:
        if "color" not in names(file):
            raise ValueError(f"{reference}: missing reference; it has {', '.join(names(file))}, not 'color'")
        found = _reference_set(file, reference).shape
    if (found[0], *found[-2:]) != (shape[0], *shape[-2:]):
        raise ValueError(f"{reference}: 'color' has the shape {found}, but {path.name} has {shape}")


def _reference(path: Path) -> Path | None:
    match = _INPUT.fullmatch(path.name)
    stem = match["name"] if match else path.stem
    candidates = (path.with_name(f"{stem}_{word}{path.suffix}") for word in _REFERENCES)
    return next((c for c in candidates if c.is_file()), None)


def _input(file: h5py.File, path: Path, name: str) -> h5py.Dataset:
    found = dataset(file, name, 5)
    if found.shape[2] != _CHANNELS[name]:
        raise ValueError(
            f"{path}: data set {name!r} has {found.shape[2]} channels in the shape {found.shape}, expected "
            f"[frame, sample, {_CHANNELS[name]}, y, x]"
        )
    return found


def _reference_set(file: h5py.File, path: Path) -> h5py.Dataset:
    import h5py

    # Only numbers in this very file are asked for their rank; `dataset` refuses the rest.
    link = file.get("color", getlink=True)
    plain = isinstance(link, h5py.HardLink) and not getattr(file["color"], "is_virtual", True)
    rank = 5 if plain and file["color"].ndim == 5 else 4
    found = dataset(file, "color", rank)
    if found.shape[-3] != 3 or (rank == 5 and found.shape[1] != 1):
        raise ValueError(
            f"{path}: data set 'color' has the shape {found.shape}, expected [frame, 3, y, x] or "
            "[frame, 1, 3, y, x]"
        )
    return found


def _target(file: h5py.File, path: Path, index: int) -> Image:
    values = items(_reference_set(file, path), index)
    return _radiance(_last(values[0] if values.ndim == 4 else values))


def _last(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (…, channel, y, x) as (…, y, x, channel)."""
    return np.ascontiguousarray(np.moveaxis(values, -3, -1))


def _radiance(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radiance in which what overflowed half precision is its largest number, as the authors do."""
    return np.where(values == np.inf, np.float32(HALF_MAX), values)


def _parts(raw: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    height, width = raw["color"].shape[1:3]
    return {
        "radiance": raw["color"],
        "normal": raw["normals_depth"][..., :3].copy(),
        "depth": raw["normals_depth"][..., 3:].copy(),
        "diffuse_albedo": raw["albedo"],
        "specular_albedo": raw["specular"][..., :3].copy(),
        "roughness": raw["specular"][..., 3:].copy(),
        "lens": raw["uvt"][..., :2].copy(),
        "time": raw["uvt"][..., 2:].copy(),
        "motion": raw["motionvecs"][..., :2] * np.array([width / 2, height / 2], np.float32),
        "coc": raw["motionvecs"][..., 2:] * np.float32(2),
    }
