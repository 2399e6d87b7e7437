"""Pictures of attention, as figure 10 of Yu et al. 2021: where each block of a network looks for a pixel.

Above the denoised image and the patch around the pixel, below the pixels that it reads and one map per block.
A map is the mean over the heads; its colours run from blue, no weight, to red, the map's largest, which is
written below it. What went to places outside of the image is in no map, and said where there is any.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from PIL import Image, ImageDraw

from trainer.attention import Attention
from trainer.reports.pictures import Array, Picture, font, tone_map

PATCH = 64
"""Side in pixels of the patch that is enlarged."""

_TALL, _MAP, _GAP = 320, 168, 12
_SIZE, _LINE = 15, 22
_BACKGROUND, _TEXT, _FAINT = (24, 24, 27), (236, 236, 238), (161, 161, 170)
_BOX, _POINT = (255, 214, 10), (230, 20, 20)
_STOPS = ((26, 34, 120), (40, 90, 190), (95, 165, 215), (190, 220, 225), (250, 235, 170), (245, 160, 75),
          (215, 60, 40), (135, 10, 25))  # fmt: skip

Box = tuple[float, float, float, float]


@cache
def heat() -> Picture:
    """Return the 256 colours of the maps, (256, 3) uint8: deep blue over pale yellow to deep red."""
    places = np.linspace(0, len(_STOPS) - 1, 256)
    columns = [np.interp(places, range(len(_STOPS)), channel) for channel in zip(*_STOPS, strict=True)]
    return np.rint(np.stack(columns, -1)).astype(np.uint8)


def attention_map(weights: Array) -> Image.Image:
    """Return weights (H, W) in the colours of `heat`, the largest in the last one."""
    top = float(weights.max()) or 1.0
    return Image.fromarray(heat()[np.rint(np.clip(weights / top, 0, 1) * 255).astype(np.intp)])


def attention_picture(denoised: Array, exposure: float, attention: Attention, label: str = "") -> Image.Image:
    """Return the image with the patch marked, the patch with the query as a red point, and all maps.

    Args:
        denoised: Radiance of the whole frame (H, W, 3).
        exposure: Factor that brings radiance to a displayable level.
        attention: What to show.
        label: Of the frame.
    """
    maps = attention.maps.mean(1)
    image = tone_map(denoised, exposure)
    x, y = attention.query
    heads = attention.maps.shape[1]
    title = f"attention of pixel {x},{y}" + (f" of {label}" if label else "")
    note = f"mean of {heads} head{'s' * (heads != 1)}; colours from 0 to the largest weight of each map"
    lower = [_window(image, attention), *(_map(weights, attention) for weights in maps)]
    titles = [f"{maps.shape[2]}x{maps.shape[1]} pixels it reads"]
    titles += [f"block {number + 1}" for number in range(len(maps))]
    captions = [["red: the pixel"], *(_facts(weights) for weights in maps)]
    width = len(lower) * (_MAP + _GAP) + 64
    patch = _patch(image, attention)
    whole = _whole(image, attention, width - patch.width - 3 * _GAP)
    lines = 1 + max(map(len, captions))
    heights = (_GAP + 2 * _LINE + 4, _LINE + _TALL + _GAP, lines * _LINE + _MAP + _GAP)
    canvas = Image.new("RGB", (width, sum(heights)), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    draw.text((_GAP, _GAP), title, _TEXT, font(_SIZE + 2), anchor="la")
    draw.text((_GAP, _GAP + _LINE + 2), note, _FAINT, font(_SIZE - 1), anchor="la")
    _place(canvas, (_GAP, heights[0]), whole, f"denoised, {image.width}x{image.height}")
    _place(canvas, (2 * _GAP + whole.width, heights[0]), patch, "the marked patch")
    top = heights[0] + heights[1]
    for index, panel in enumerate(lower):
        _place(canvas, (_GAP + index * (_MAP + _GAP), top), panel, titles[index], captions[index])
    _scale(canvas, (width - 52, top + _LINE))
    return canvas


def _place(
    canvas: Image.Image,
    corner: tuple[int, int],
    panel: Image.Image,
    title: str,
    captions: list[str] | None = None,
) -> None:
    draw, (x, y) = ImageDraw.Draw(canvas), corner
    draw.text((x, y + _LINE / 2), title, _TEXT, font(_SIZE), anchor="lm")
    canvas.paste(panel, (x, y + _LINE))
    for number, text in enumerate(captions or []):
        middle = y + (number + 1.5) * _LINE + _MAP
        draw.text((x, middle), text, _FAINT, font(_SIZE - 1), anchor="lm")


def _whole(image: Image.Image, attention: Attention, room: int) -> Image.Image:
    """Return the image with the patch marked, as large as fits into `room` x `_TALL`."""
    factor = min(room / image.width, _TALL / image.height)
    factor = float(int(factor)) if factor >= 1 else factor
    size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
    shown = image.resize(size, Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.BOX)
    left, top, right, bottom = _patch_box(image, attention)
    _outline(shown, (left * factor, top * factor, right * factor, bottom * factor), 2)
    return shown


def _patch_box(image: Image.Image, attention: Attention) -> tuple[int, int, int, int]:
    sides = []
    for position, size in zip(attention.query, image.size, strict=True):
        length = min(PATCH, size)
        start = min(max(0, position - length // 2), size - length)
        sides.append((start, start + length))
    return sides[0][0], sides[1][0], sides[0][1], sides[1][1]


def _patch(image: Image.Image, attention: Attention) -> Image.Image:
    """Return the patch enlarged, with the pixels that are read outlined and the query as a point."""
    box = _patch_box(image, attention)
    cut = image.crop(box)
    factor = max(1, _TALL // max(cut.size))
    shown = cut.resize((cut.width * factor, cut.height * factor), Image.Resampling.NEAREST)
    left, top = (start - edge for start, edge in zip(attention.corner, box[:2], strict=True))
    height, width = attention.maps.shape[-2:]
    _outline(shown, (left * factor, top * factor, (left + width) * factor, (top + height) * factor), 2)
    _point(shown, attention.query[0] - box[0], attention.query[1] - box[1], factor)
    return shown


def _window(image: Image.Image, attention: Attention) -> Image.Image:
    """Return the pixels that the query reads, as large as the maps."""
    (left, top), (height, width) = attention.corner, attention.maps.shape[-2:]
    shown = _enlarged(image.crop((left, top, left + width, top + height)))
    _point(shown, attention.query[0] - left, attention.query[1] - top, shown.width // width)
    return shown


def _map(weights: Array, attention: Attention) -> Image.Image:
    """Return one map, with the query's own pixel framed so that its colour stays visible."""
    shown = _enlarged(attention_map(weights))
    factor = shown.width // weights.shape[1]
    x, y = ((q - c) * factor for q, c in zip(attention.query, attention.corner, strict=True))
    draw = ImageDraw.Draw(shown)
    draw.rectangle((x - 1, y - 1, x + factor, y + factor), outline=(0, 0, 0))
    draw.rectangle((x, y, x + factor - 1, y + factor - 1), outline=(255, 255, 255))
    return shown


def _enlarged(picture: Image.Image) -> Image.Image:
    factor = max(1, _MAP // max(picture.size))
    return picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST)


def _facts(weights: Array) -> list[str]:
    outside = 1 - float(weights.sum(dtype=np.float64))
    times = float(weights.max() / weights.mean())
    return [
        f"largest {weights.max():.2g}, {times:.2g}x mean",
        *([f"{outside:.0%} outside"] if outside >= 0.005 else []),
    ]


def _outline(picture: Image.Image, box: Box, line: int) -> None:
    """Draw a yellow rectangle around pixels, with a dark edge that shows it on bright ones."""
    draw = ImageDraw.Draw(picture)
    left, top, right, bottom = (round(value) for value in box)
    draw.rectangle((left - 1, top - 1, right, bottom), outline=(0, 0, 0))
    draw.rectangle((left, top, right - 1, bottom - 1), outline=_BOX, width=line)


def _point(picture: Image.Image, column: int, row: int, factor: int) -> None:
    x, y, radius = (column + 0.5) * factor, (row + 0.5) * factor, max(3.0, 0.35 * factor)
    draw = ImageDraw.Draw(picture)
    draw.ellipse((x - radius - 1, y - radius - 1, x + radius + 1, y + radius + 1), fill=(255, 255, 255))
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_POINT)


def _scale(canvas: Image.Image, corner: tuple[int, int]) -> None:
    """Draw the colours upright, beside the maps."""
    x, y = corner
    bar = heat()[::-1][np.linspace(0, 255, _MAP).astype(int)]
    canvas.paste(Image.fromarray(np.repeat(bar[:, None], 12, axis=1)), corner)
    draw = ImageDraw.Draw(canvas)
    for text, height in (("max", 8), ("0", _MAP - 8)):
        draw.text((x + 16, y + height), text, _FAINT, font(_SIZE - 2), anchor="lm")
