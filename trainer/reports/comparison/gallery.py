"""The pictures of the page: which frames, how exact, and each of them as text.

A page must stay small enough to be opened and sent: the pictures have the finest of `QUALITIES` with which
those of all frames fit; where even the coarsest does not do, fewer frames have pictures, chosen evenly from
all scenes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from trainer.evaluation.plan import INPUT, REFERENCE
from trainer.evaluation.scores import load
from trainer.reports.comparison.coding import bits_of, encode, to_text
from trainer.reports.comparison.levels import Array, Scale, to_planes
from trainer.reports.comparison.maps import block_means, flip_map

BUDGET = 55_000_000
"""Bytes of all pictures together, as text; scripts, tables and names come beside them."""


class Quality(NamedTuple):
    """How exact pictures are: the bound on the relative error, and the side of the blocks of FLIP maps."""

    bound: float
    block: int


QUALITIES = (
    Quality(0.005, 1),
    Quality(0.01, 1),
    *(Quality(b, 2) for b in (0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05)),
)
NOISE = 2.0
"""How much coarser than the others the noisy input is stored: its pixels are off by more than that anyway."""

_PILOTS, _SIDE = 3, 320
_MOST = (48.0, 7.0)
"""More bits than a pixel of a picture and of a FLIP map take at the finest bound."""
_LETTER = 8 * 2 / 13  # letters per byte


@dataclass(frozen=True)
class Column:
    """What a frame is shown by: the input, a method, or the reference."""

    label: str
    folder: str

    @property
    def looseness(self) -> float:
        """Its bound in bounds of the page."""
        return NOISE if self.folder == INPUT else 1.0


@dataclass(frozen=True)
class Picture:
    """One image of one frame.

    Attributes:
        key: Of its element in the page, followed by `p` for radiance and `f` for the FLIP map.
        path: Its EXR file.
        target: The EXR file of its reference, None where there is none or it is one.
        scale: What its levels mean.
    """

    key: str
    path: Path
    target: Path | None
    scale: Scale

    @property
    def column(self) -> str:
        """Number of its column."""
        return self.key.partition("-")[2]


@dataclass(frozen=True)
class Gallery:
    """All pictures of the page.

    Attributes:
        frames: Numbers of the frames that have pictures.
        quality: How exact they are; the noisy input is `NOISE` times coarser.
        pictures: Of every frame and column whose file is there, frame by frame.
    """

    frames: tuple[int, ...]
    quality: Quality
    pictures: tuple[Picture, ...] = field(repr=False)

    def texts(self, workers: int = 2) -> Iterator[tuple[str, str]]:
        """Yield key and text of every picture and FLIP map, in order.

        Raises:
            OSError: A file is missing or cannot be opened.
            ValueError: A file is damaged.
        """
        # Files are read here and not by the threads: the reader redirects the standard output of the process.
        with (
            _single_threaded(),
            ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool,
        ):
            waiting: list[Future[list[tuple[str, str]]]] = []
            target: tuple[Path | None, Array | None] = None, None
            for picture in self.pictures:
                if picture.target != target[0] and picture.target is not None:
                    target = picture.target, _read(picture.target)
                radiance = _read(picture.path)
                compared = target[1] if picture.target is not None else None
                waiting.append(pool.submit(_texts, picture, radiance, compared, self.quality.block))
                if len(waiting) > workers:
                    yield from waiting.pop(0).result()
            for future in waiting:
                yield from future.result()


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Let every thread work alone: on busy machines threads of threads wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def gallery_of(
    images: Path, frames: Sequence[dict[str, Any]], columns: Sequence[Column], budget: int = BUDGET
) -> Gallery:
    """Return the pictures that fit.

    Args:
        images: Folder of the images.
        frames: As in `evaluation.json`.
        columns: What is shown of each frame.
        budget: Bytes for all pictures.

    Raises:
        OSError: A file cannot be opened.
        ValueError: A file is damaged.
    """
    pictures = {i: _pictures(images, i, frame, columns) for i, frame in enumerate(frames)}
    # No row knows the size of a frame that only an earlier evaluation of the folder could denoise.
    order = [i for i in _spread(frames) if pictures[i] and frames[i]["width"]]
    if not order:
        return Gallery((), QUALITIES[0], ())
    everything = [picture for i in order for picture in pictures[i]]
    most = {str(c): sum(_MOST) for c in range(len(columns))}
    fits = sum(_sizes(everything, most, frames)) < budget
    density, chosen = [most] * len(QUALITIES) if fits else _densities(everything), 0
    while chosen < len(QUALITIES) - 1 and sum(_sizes(everything, density[chosen], frames)) > budget:
        chosen += 1
    kept: list[int] = []
    quality, used = QUALITIES[chosen], 0.0
    for i in order:
        used += sum(_sizes(pictures[i], density[chosen], frames))
        if kept and used > budget:
            break
        kept.append(i)
    shown = tuple(sorted(kept))
    return Gallery(shown, quality, tuple(_bounded(p, quality.bound) for i in shown for p in pictures[i]))


def _read(path: Path) -> Array:
    """Return the radiance (H, W, 3) of an EXR file."""
    return load(path).movedim(0, -1).numpy()


def _pictures(images: Path, number: int, frame: dict[str, Any], columns: Sequence[Column]) -> list[Picture]:
    target = images / REFERENCE / f"{frame['name']}.exr"
    found = []
    for c, column in enumerate(columns):
        path = images / column.folder / f"{frame['name']}.exr"
        if path.is_file():
            compared = target if target.is_file() and path != target else None
            scale = Scale(column.looseness, _exposure(frame))
            found.append(Picture(f"{number}-{c}", path, compared, scale))
    return found


def _exposure(frame: dict[str, Any]) -> float:
    """Return the exposure of a frame, 1 where it is not known."""
    known = frame.get("exposure")
    return float(known) if known and math.isfinite(known) else 1.0


def _bounded(picture: Picture, bound: float) -> Picture:
    """Return the picture with the bound of the page; so far it has how much coarser than that it is."""
    return replace(picture, scale=replace(picture.scale, bound=picture.scale.bound * bound))


def _spread(frames: Sequence[dict[str, Any]]) -> list[int]:
    """Return the numbers of frames: the middle one of each scene first, then ever more of each."""
    scenes: dict[str, list[int]] = {}
    for i, frame in enumerate(frames):
        scenes.setdefault(frame["scene"], []).append(i)
    ranked: list[tuple[float, int]] = []
    for members in scenes.values():
        for place, i in enumerate(members):
            ranked.append((_turn(place, len(members)), i))
    return [i for _, i in sorted(ranked)]


def _turn(place: int, count: int) -> float:
    """Return when a frame of a scene is taken: halves, then quarters … of the scene."""
    low, high, turn = 0, count, 0
    while True:
        middle = (low + high) // 2
        if place == middle:
            return turn
        low, high = (low, middle) if place < middle else (middle + 1, high)
        turn += 1


def _densities(pictures: Sequence[Picture]) -> list[dict[str, float]]:
    """Return for each quality how many bits a pixel of each column takes, its FLIP map included."""
    chosen: list[Picture] = []
    for column in dict.fromkeys(p.column for p in pictures):
        kind = [p for p in pictures if p.column == column]
        chosen += [kind[i] for i in np.linspace(0, len(kind) - 1, min(_PILOTS, len(kind))).astype(int)]
    samples: list[dict[str, list[float]]] = [{} for _ in QUALITIES]
    with _single_threaded():
        for picture in chosen:
            _measure(picture, samples)
    return [{key: float(np.mean(values)) for key, values in found.items()} for found in samples]


def _measure(picture: Picture, samples: list[dict[str, list[float]]]) -> None:
    """Add the bits that a pixel in the middle of a picture takes, for each quality."""
    crop, maps = _middle(_read(picture.path)), {}
    other = crop if picture.target is None else _middle(_read(picture.target))
    if picture.target is not None and other.shape == crop.shape:
        flip = flip_map(crop, other, picture.scale.exposure)
        maps = {block: bits_of([block_means(flip, block)]) for block in {q.block for q in QUALITIES}}
    for quality, found in zip(QUALITIES, samples, strict=True):
        bits = bits_of(to_planes(crop, _bounded(picture, quality.bound).scale)) + maps.get(quality.block, 0)
        found.setdefault(picture.column, []).append(bits / crop[..., 0].size)


def _sizes(
    pictures: Sequence[Picture], density: dict[str, float], frames: Sequence[dict[str, Any]]
) -> Iterator[float]:
    """Yield the bytes that each picture will take on the page, with its FLIP map."""
    for picture in pictures:
        frame = frames[int(picture.key.partition("-")[0])]
        bits = density[picture.column]
        # Tables, states and the borders of pilots are the rest.
        yield (frame["width"] * frame["height"] * bits / 8 * 1.02 + 6000) * _LETTER


def _middle(image: Array) -> Array:
    height, width = image.shape[:2]
    y, x = max(0, height - _SIDE) // 2, max(0, width - _SIDE) // 2
    return image[y : y + _SIDE, x : x + _SIDE]


def _texts(picture: Picture, radiance: Array, target: Array | None, block: int) -> list[tuple[str, str]]:
    found = [(f"{picture.key}p", to_text(encode(to_planes(radiance, picture.scale))))]
    if target is not None and target.shape == radiance.shape:
        flip = flip_map(radiance, target, picture.scale.exposure)
        found.append((f"{picture.key}f", to_text(encode([block_means(flip, block)]))))
    return found
