"""Pictures to look at: tone-mapped images, labelled comparisons, false-colour error maps.

Everything is shown at one exposure with the tone curve of the metrics, `clamp(max(e x, 0)^0.454545, 0, 1)`,
so that the numbers below a picture judge what the picture shows.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Array = NDArray[np.float32]
Picture = NDArray[np.uint8]

GAMMA = 0.454545
ERROR_SCALE = 0.25
"""Difference of display values (0 to 1) at which an error map reaches its brightest colour. It is fixed, so
that maps of different epochs and methods can be compared."""

_ERROR = ("absolute difference", "of display values,", "mean of R, G, B")
_BACKGROUND, _TEXT, _FAINT = (24, 24, 27), (236, 236, 238), (161, 161, 170)
_SMALLEST, _WIDEST = 256, 640
"""Widths between which a panel is shown: crops are enlarged in whole steps, frames are reduced."""


class Panel(NamedTuple):
    """One cell of a grid: 8-bit picture (H, W, 3), title above, line below."""

    picture: Image.Image
    title: str = ""
    caption: str = ""


def display(radiance: Array, exposure: float = 1.0) -> Array:
    """Return display values in [0, 1], (H, W, 3), of linear radiance; NaN and negative values are black."""
    exposed = np.nan_to_num(np.asarray(radiance, np.float32) * np.float32(exposure), nan=0.0, posinf=1.0)
    return np.power(np.clip(exposed, 0, 1), np.float32(GAMMA))


def tone_map(radiance: Array, exposure: float = 1.0) -> Image.Image:
    """Return an 8-bit picture of linear radiance (H, W, 3)."""
    return Image.fromarray(np.rint(display(radiance, exposure) * 255).astype(np.uint8))


def difference(radiance: Array, reference: Array, exposure: float) -> Array:
    """Return the absolute difference of display values, averaged over RGB: (H, W) in [0, 1]."""
    return np.abs(display(radiance, exposure) - display(reference, exposure)).mean(-1)


def error_map(radiance: Array, reference: Array, exposure: float) -> Image.Image:
    """Return the false-colour picture of `difference`; black is none, bright yellow `ERROR_SCALE` or more."""
    return false_color(difference(radiance, reference, exposure) / ERROR_SCALE)


def false_color(values: Array) -> Image.Image:
    """Return the colours of values (H, W), 0 to 1 and clipped to that."""
    return Image.fromarray(colors()[np.rint(np.clip(values, 0, 1) * 255).astype(np.intp)])


@cache
def colors() -> Picture:
    """Return the 256 colours of the error maps, (256, 3) uint8: black over violet and orange to pale yellow.

    Lightness rises in equal steps of Oklab (Ottosson 2020), so that equal steps of error look equal and the
    map survives a grey print.
    """
    t = np.linspace(0, 1, 256)
    stops = [0.0, 0.15, 0.4, 0.65, 0.85, 1.0]
    hue = np.deg2rad(np.interp(t, stops, [285, 295, 355, 400, 445, 465]))
    chroma = np.interp(t, stops, [0.0, 0.12, 0.2, 0.18, 0.16, 0.1])
    lightness = 0.02 + 0.95 * t
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], -1)
    # Oklab to linear sRGB.
    lms = lab @ np.array(
        [[1, 1, 1], [0.39633778, -0.10556135, -0.08948418], [0.21580376, -0.06385417, -1.29148555]]
    )
    linear = lms**3 @ np.array(
        [[4.07674166, -1.26843800, -0.00419609], [-3.30771159, 2.60975740, -0.70341861],
         [0.23096993, -0.34131940, 1.70761470]]
    )  # fmt: skip
    linear = np.clip(linear, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(encoded * 255).astype(np.uint8)


def comparison(
    noisy: Array | None,
    accumulated: Array | None,
    denoised: Array,
    reference: Array | None,
    exposure: float,
    title: str = "",
) -> Image.Image:
    """Return noisy, accumulated, denoised and reference side by side, with their error maps below.

    Args:
        noisy: Radiance of the frame alone (H, W, 3); left out where None, as are the next.
        accumulated: Radiance accumulated over the preceding frames.
        denoised: The result.
        reference: Converged radiance; without it there are no metrics and no error maps.
        exposure: Factor that brings radiance to a displayable level; the same for all.
        title: Line above everything.
    """
    named = {"noisy": noisy, "accumulated": accumulated, "denoised": denoised, "reference": reference}
    shown = {name: image for name, image in named.items() if image is not None}
    top = []
    for name, image in shown.items():
        caption = "" if reference is None else _score(name, image, reference, exposure)
        top.append(Panel(sized(tone_map(image, exposure)), name, caption))
    rows = [top]
    if reference is not None:
        maps = [
            Panel(sized(error_map(image, reference, exposure)), f"error of {name}")
            for name, image in shown.items()
            if name != "reference"
        ]
        rows.append([*maps, Panel(legend(top[0].picture.size, ERROR_SCALE, _ERROR))])
    return grid(rows, title or f"exposure {exposure:.4g}")


def grid(rows: list[list[Panel]], title: str = "") -> Image.Image:
    """Return panels of one size in rows, with their titles and captions."""
    width, height = rows[0][0].picture.size
    gap, size = 10, 15 if width < 400 else 18
    line = size + 10
    heights = [
        (line if any(p.title for p in row) else 0) + height + (line if any(p.caption for p in row) else 0)
        for row in rows
    ]
    columns = max(len(row) for row in rows)
    top = gap + (line + 4 if title else 0)
    canvas = Image.new(
        "RGB", (gap + columns * (width + gap), top + sum(heights) + gap * len(rows)), _BACKGROUND
    )
    draw = ImageDraw.Draw(canvas)
    if title:
        draw.text((gap, gap), title, _TEXT, font(size + 1), anchor="la")
    y = top
    for row, row_height in zip(rows, heights, strict=True):
        has_title = any(p.title for p in row)
        for column, panel in enumerate(row):
            x = gap + column * (width + gap)
            if panel.title:
                draw.text((x, y + line / 2), panel.title, _TEXT, font(size), anchor="lm")
            picture_y = y + (line if has_title else 0)
            canvas.paste(panel.picture, (x, picture_y))
            if panel.caption:
                draw.text(
                    (x, picture_y + height + line / 2), panel.caption, _FAINT, font(size - 1), anchor="lm"
                )
        y += row_height + gap
    return canvas


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own font, which needs no file."""
    return ImageFont.load_default(size)


def sized(picture: Image.Image) -> Image.Image:
    """Return a picture as large as panels are: crops enlarged in whole steps, frames reduced."""
    width, height = picture.size
    if width > _WIDEST:
        return picture.resize((_WIDEST, max(1, round(height * _WIDEST / width))), Image.Resampling.BOX)
    factor = max(1, -(-_SMALLEST // width))
    return picture.resize((width * factor, height * factor), Image.Resampling.NEAREST)


def _score(name: str, image: Array, reference: Array, exposure: float) -> str:
    if name == "reference":
        return "target"
    import torch

    from trainer.metrics.functional import psnr_wskp, ssim_wskp

    def exposed(array: Array) -> torch.Tensor:
        planes = (array * np.float32(exposure)).transpose(2, 0, 1)
        return torch.from_numpy(np.ascontiguousarray(planes))[None]

    output, target = exposed(image), exposed(reference)
    text = f"PSNR {float(psnr_wskp(output, target)):.2f} dB"
    if min(image.shape[:2]) < 7:  # smaller than the window of SSIM
        return text
    return f"{text}   SSIM {float(ssim_wskp(output, target)):.3f}"


def legend(size: tuple[int, int], top: float, lines: tuple[str, ...], more: bool = True) -> Image.Image:
    """Return the colour bar of `false_color`, upright, as large as a panel.

    Args:
        size: Width and height.
        top: The value of the brightest colour.
        lines: What the values are, beside the bar where there is room.
        more: There may be larger values than `top`, which are drawn as it is.
    """
    width, height = size
    picture = Image.new("RGB", size, _BACKGROUND)
    draw = ImageDraw.Draw(picture)
    margin = 12
    bar = colors()[::-1][np.linspace(0, 255, height - 2 * margin).astype(int)]
    picture.paste(Image.fromarray(np.repeat(bar[:, None], 22, axis=1)), (2, margin))
    for fraction in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        y = margin + (1 - fraction) * (height - 2 * margin - 1)
        label = _number(fraction * top, top) + (" and more" if more and fraction == 1 else "")
        draw.line([(24, y), (29, y)], _FAINT)
        draw.text((34, y), label, _FAINT, font(14), anchor="lm")
    if width >= 240:
        for number, text in enumerate(lines):
            y = height / 2 + (number - 0.5 * (len(lines) - 1)) * 20
            draw.text((width - 8, y), text, _FAINT, font(14), anchor="rm")
    return picture


def _number(value: float, top: float) -> str:
    return f"{value:.2f}" if 0.1 <= top < 100 else f"{value:.2g}"
