"""What `trainer denoise` writes for a frame: the result, pictures, layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data.buffers import BUFFERS
from data.exr import write_exr, write_frame
from data.frame import Image
from trainer.clips import Item
from trainer.denoising import Result
from trainer.outputs import replacing
from trainer.samples import layer_pictures
from trainer.weights import SHEET, weight_pictures

if TYPE_CHECKING:
    from PIL.Image import Image as Picture


@dataclass(frozen=True)
class Wanted:
    """Which results are written, and where.

    Attributes:
        folder: For all of them.
        png: Pictures too.
        attention: A picture of attention too.
        aux: What the method made on its way too, and a picture of it where pictures are wanted.
        layers: A folder of pictures of every layer too.
        weights: A folder of pictures of what every kernel makes too.
    """

    folder: Path
    png: bool
    attention: bool
    aux: bool = False
    layers: bool = False
    weights: bool = False

    def paths(self, item: Item) -> dict[str, Path]:
        """Return the files of a frame by what they show; those of pictures only where they are wanted."""
        suffixes = {"exr": ".exr"}
        if self.png:
            suffixes |= {"denoised": ".png", "comparison": "_comparison.png"}
        if self.attention:
            suffixes["attention"] = "_attention.png"
        if self.aux:
            suffixes["aux"] = "_aux.exr"
        if self.aux and self.png:
            suffixes["sheet"] = "_aux.png"
        if self.layers:
            suffixes["layers"] = "_layers"
        if self.weights:
            suffixes["weights"] = "_weights"
        return {kind: self.folder / f"{item.name}{suffix}" for kind, suffix in suffixes.items()}


def write(result: Result, paths: Mapping[str, Path]) -> None:
    """Write the results of a frame, its EXR file last: a frame that has it is finished.

    Args:
        result: The frame.
        paths: From `Wanted.paths`.

    Raises:
        OSError: A file cannot be written.
    """
    exr = paths["exr"]
    exr.parent.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(result, "sheet" in paths) if "denoised" in paths else {}
    for kind, image in pictures.items():
        with replacing(paths[kind]) as temporary:
            image.save(temporary)
    if "aux" in paths:
        write_aux(paths["aux"], result)
    if "layers" in paths:
        _write_folder(paths["layers"], layer_pictures(result))
    if "weights" in paths:
        _write_folder(paths["weights"], weight_pictures(result))
    write_frame(result.frame, exr)


def _write_folder(folder: Path, pictures: Mapping[str, Picture]) -> None:
    """Write pictures into a folder of their own, in which those of an earlier run are not left."""
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.png"):
        if old.stem not in pictures:
            old.unlink()
    for name, image in pictures.items():
        with replacing(folder / f"{name}.png") as temporary:
            image.save(temporary)


def write_aux(path: Path, result: Result) -> None:
    """Write what a method made on its way as the layers of one EXR file.

    The result is in R, G, B, which every viewer shows; others are `<layer>.<letter>` with the letters of the
    vocabulary, where points in names of layers are written as `_`, since viewers take them for groups.

    Raises:
        OSError: The file cannot be written; nothing is left behind.
    """
    layers: dict[str, Image] = {"": result.frame.buffers["color"], **result.aux}
    channels = {}
    for name, image in layers.items():
        layer = name.replace(".", "_")
        for letter, plane in zip(_letters(name, image), np.moveaxis(image, -1, 0), strict=True):
            channels[f"{layer}.{letter}" if layer else letter] = np.ascontiguousarray(plane, np.float32)
    write_exr(path, channels, {"comments": f"{result.frame.label}: {', '.join(result.aux)}"})


def _letters(name: str, image: Image) -> Sequence[str]:
    if name in BUFFERS:
        return BUFFERS[name].letters
    return {1: "Y", 2: "XY"}.get(image.shape[2], "RGB")


def _pictures(result: Result, sheet: bool) -> dict[str, Picture]:
    from trainer.reports.attention import attention_picture
    from trainer.reports.composite import is_layered
    from trainer.reports.fusion import is_fused
    from trainer.reports.layers import layer_sheet
    from trainer.reports.pictures import comparison, tone_map

    color, exposure, label = result.frame.buffers["color"], result.exposure, result.frame.label
    pictures = {"denoised": tone_map(color, exposure)}
    if result.reference is not None:
        title = f"{label}, exposure {exposure:.4g}"
        pictures["comparison"] = comparison(
            result.noisy, result.accumulated, color, result.reference, exposure, title
        )
    if result.attention is not None:
        pictures["attention"] = attention_picture(color, exposure, result.attention, label)
    if sheet:
        if is_layered(result.aux):
            pictures["sheet"] = layer_pictures(result)["layers"]
        elif is_fused(result.aux):
            pictures["sheet"] = weight_pictures(result)[SHEET]
        else:
            pictures["sheet"] = layer_sheet(color, exposure, result.aux, label)
    return pictures
