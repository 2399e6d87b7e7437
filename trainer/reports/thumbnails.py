"""Small pictures of buffers for the data report, as data URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from data.buffers import BUFFERS, buffer
from trainer.reports.pictures import colors, false_color, tone_map

Array = NDArray[np.float32]

QUALITY = 82
"""JPEG quality of thumbnails."""

FEW = 1024
"""Colours up to which a picture may be smaller as PNG, which takes long to try."""

PERCENTILES = (1.0, 99.0)
"""Values of distances and variances between which the colours of a thumbnail reach."""


class Thumbnail(NamedTuple):
    """A picture in a page.

    Attributes:
        uri: The picture as a `data:` URI.
        width: Columns in pixels.
        height: Rows in pixels.
        note: How values became colours.
    """

    uri: str
    width: int
    height: int
    note: str = ""


def thumbnail(picture: Image.Image, limit: int, note: str = "", *, flat: bool = False) -> Thumbnail:
    """Return a picture reduced to at most `limit` columns and rows, as JPEG or PNG, whichever is smaller.

    Args:
        picture: 8-bit RGB.
        limit: Largest width and height in pixels.
        note: Line below it.
        flat: The colours mean something, so JPEG must keep their resolution.
    """
    picture = reduced(picture, limit)
    options: dict[str, dict[str, Any]] = {"JPEG": {"quality": QUALITY, "subsampling": 0 if flat else 2}}
    if picture.getcolors(FEW) is not None:
        options["PNG"] = {}
    coded = {}
    for kind, settings in options.items():
        stream = io.BytesIO()
        picture.save(stream, kind, **settings)
        coded[kind] = stream.getvalue()
    kind = min(coded, key=lambda k: len(coded[k]))
    text = base64.b64encode(coded[kind]).decode()
    return Thumbnail(f"data:image/{kind.lower()};base64,{text}", picture.width, picture.height, note)


def reduced(picture: Image.Image, limit: int) -> Image.Image:
    """Return a picture of at most `limit` columns and rows, the same where it is that small."""
    factor = limit / max(picture.size)
    if factor >= 1:
        return picture
    size = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
    return picture.resize(size, Image.Resampling.BOX)


def buffer_thumbnail(name: str, image: Array, exposure: float, limit: int) -> Thumbnail:
    """Return a buffer as a picture.

    Radiance is tone-mapped at the frame's exposure, reflectance shown with the same curve, normals mapped
    from [-1, 1], motion shown as hue (direction) and brightness (length), other quantities in false colours:
    distances between two percentiles, variances on a logarithmic scale.

    Args:
        name: Word of the vocabulary.
        image: Values (H, W, C).
        exposure: Factor to a displayable level.
        limit: Largest width and height in pixels.
    """
    picture, note = picture_of(name, image, exposure)
    return thumbnail(picture, limit, note, flat=buffer(name).kind != "radiance")


def in_order(names: Iterable[str]) -> list[str]:
    """Return names of buffers in the order of the vocabulary, after `color` and `reference`."""
    places = {name: i for i, name in enumerate(("color", "reference", *BUFFERS))}
    places |= {"color": 0, "reference": 1}
    return sorted(names, key=places.__getitem__)


def picture_of(name: str, image: Array, exposure: float) -> tuple[Image.Image, str]:
    """Return the picture of a buffer in full size, and how values became colours."""
    entry = buffer(name)
    image = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
    if entry.kind == "radiance":
        return tone_map(image, exposure), f"exposure {exposure:.3g}"
    if entry.kind == "ratio" and entry.channels == 3:
        return tone_map(image), "0 to 1"
    if name.startswith("normal") and entry.kind == "vector":
        return _rgb(image * 0.5 + 0.5), "−1 to 1"
    if entry.kind == "vector":
        return _motion(image)
    if entry.kind == "variance":
        return _variance(image)
    if entry.kind == "distance" and entry.channels == 3:
        return _position(image)
    if entry.kind == "ratio":
        return _grey(np.clip(image[..., 0], 0, 1)), "0 to 1"
    return _distance(image[..., 0], entry.no_hit)


def _rgb(values: Array) -> Image.Image:
    return Image.fromarray(np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8))


def _grey(values: Array) -> Image.Image:
    return _rgb(np.repeat(values[..., None], 3, -1))


def _limits(values: Array) -> tuple[float, float]:
    """Return the percentiles between which values are shown."""
    if values.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, PERCENTILES)
    return float(low), float(max(high, low + 1e-12 * max(abs(low), 1)))


def _distance(values: Array, no_hit: float) -> tuple[Image.Image, str]:
    """Show near bright and far dark; what hit nothing is black."""
    hit = values != no_hit
    low, high = _limits(values[hit])
    shown = np.where(hit, 0.12 + 0.85 * (1 - np.clip((values - low) / (high - low), 0, 1)), 0)
    return false_color(shown.astype(np.float32)), f"{low:.3g} (bright) to {high:.3g}"


def _position(values: Array) -> tuple[Image.Image, str]:
    """Show X, Y, Z as R, G, B, each between its percentiles."""
    hit = (values != 0).any(-1)
    shown = np.zeros_like(values)
    for axis in range(3):
        low, high = _limits(values[..., axis][hit])
        shown[..., axis] = np.where(hit, np.clip((values[..., axis] - low) / (high - low), 0, 1), 0)
    return _rgb(shown), "X, Y, Z as R, G, B"


def _variance(values: Array) -> tuple[Image.Image, str]:
    mean = values.mean(-1)
    positive = mean[mean > 0]
    if positive.size == 0:
        return false_color(np.zeros_like(mean)), "0 everywhere"
    low, high = _limits(np.log10(positive))
    logs = np.log10(np.maximum(mean, np.float32(10.0**low)))
    shown = np.where(mean > 0, 0.1 + 0.9 * np.clip((logs - low) / (high - low), 0, 1), 0)
    return false_color(shown.astype(np.float32)), f"log, {10**low:.1e} to {10**high:.1e}"


def _motion(values: Array) -> tuple[Image.Image, str]:
    """Show direction as hue, length as brightness."""
    length = np.hypot(values[..., 0], values[..., 1])
    longest = float(np.percentile(length, PERCENTILES[1]))
    if longest == 0:
        return _grey(np.zeros_like(length)), "0 everywhere"
    hue = (np.arctan2(values[..., 1], values[..., 0]) / (2 * np.pi)) % 1
    planes = np.stack([hue, np.full_like(hue, 0.85), np.clip(length / longest, 0, 1)], -1)
    coded = np.rint(planes * 255).astype(np.uint8)
    return Image.fromarray(coded, "HSV").convert("RGB"), f"hue: direction, up to {longest:.2g} px"


def window(image: Array, side: int) -> Array:
    """Return the middle of an image (H, W, C), at most `side` columns and rows: pixels in their own size."""
    height, width = image.shape[:2]
    y, x = max(0, (height - side) // 2), max(0, (width - side) // 2)
    return image[y : y + side, x : x + side]


def expected_coverage(weights: Array, patch: int) -> Array:
    """Return which share of the patches covers each pixel, (H, W) = (rows + patch - 1, columns + patch - 1).

    Args:
        weights: How often a patch has its top left pixel here (rows, columns), on any scale.
        patch: Width and height of a patch.
    """
    rows, columns = weights.shape
    total = float(weights.sum(dtype=np.float64))
    chance = weights / total if total > 0 else np.full(weights.shape, 1 / weights.size)
    edges = np.zeros((rows + patch, columns + patch))
    edges[:rows, :columns] += chance
    edges[patch:, patch:] += chance
    edges[:rows, patch:] -= chance
    edges[patch:, :columns] -= chance
    covered = edges.cumsum(0).cumsum(1)[:-1, :-1]
    return np.clip(covered, 0, 1).astype(np.float32)


def density_picture(color: Array, exposure: float, share: Array, limit: int) -> Image.Image:
    """Return a frame in grey under the false colours of a density, with at most `limit` columns and rows.

    Args:
        color: Radiance (H, W, 3).
        exposure: Factor to a displayable level.
        share: Density (H, W) from 0 to 1, the brightest colour.
        limit: Largest side.
    """
    grey = np.asarray(tone_map(color, exposure).convert("L"), np.float32)[..., None]
    painted = colors()[np.rint(40 + 215 * np.clip(share, 0, 1)).astype(np.intp)].astype(np.float32)
    return reduced(Image.fromarray(np.rint(0.4 * grey + 0.6 * painted).astype(np.uint8)), limit)


def with_dots(picture: Image.Image, places: Iterable[tuple[float, float]]) -> Image.Image:
    """Return the picture with dots at places, given as shares of its width and height."""
    picture = picture.copy()
    draw = ImageDraw.Draw(picture)
    for x, y in places:
        draw.circle((x * picture.width, y * picture.height), 2.5, (255, 255, 255), (0, 0, 0))
    return picture
