"""Pictures of how filter kernels are fused, after figure 8 of Fan et al. 2021 (doi:10.1111/cgf.14338).

Each kernel gets three: the image that it makes alone, its fusion weight (black 0 over violet and orange to
pale yellow 1), and its log-importance (black to white). A window softmax makes kernels of the importance, so
that only differences between neighbours count: a map is shown between percentiles of its own, which are said.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from models.ops.kernel_views import PARTS
from trainer.reports.pictures import Array, Panel, false_color, font, grid, legend, sized, tone_map

FILTERED, WEIGHT, IMPORTANCE = PARTS
ALPHA = "alpha"
"""The share of the coarser result, `x1_alpha`."""

_NAME = re.compile(rf"(?:x(\d+)_)?(?:kernel0*(\d+)(?:_(\d+))?_({'|'.join(PARTS)})|({ALPHA}))")
_PERCENTILES = (1, 99)
_BACKGROUND, _FAINT = (24, 24, 27), (161, 161, 170)


class Kernel(NamedTuple):
    """A kernel, or all of a resolution where `size` is 0.

    Attributes:
        name: How names of its layers begin.
        factor: Pixels of the frame in a row of one pixel of its resolution.
        size: Rows and columns.
        number: Which one of those of its size, 0 where there is one.
    """

    name: str
    factor: int
    size: int
    number: int

    @property
    def title(self) -> str:
        """What a sheet calls it."""
        number = f" ({self.number})" if self.number else ""
        return f"{self.size}x{self.size}{number}{self.resolution}"

    @property
    def resolution(self) -> str:
        """What a sheet says of its resolution."""
        return f" at 1/{self.factor}" if self.factor > 1 else ""


def is_fused(layers: Mapping[str, Array]) -> bool:
    """Return whether a method returned what its kernels make, and nothing else."""
    return bool(layers) and all(_NAME.fullmatch(name) for name in layers)


def kernels_of(layers: Mapping[str, Array]) -> list[Kernel]:
    """Return the kernels whose layers these are, in order."""
    found: dict[Kernel, None] = {}
    for name in layers:
        match = _NAME.fullmatch(name)
        if match is not None and match[2]:
            place = (int(match[1] or 1), int(match[2]), int(match[3] or 0))
            found[Kernel(name.rpartition("_")[0], *place)] = None
    return list(found)


def importance_range(importance: Array) -> tuple[float, float]:
    """Return the values that are shown black and white: percentiles 1 and 99, rounded outwards to tenths."""
    low, high = np.percentile(importance, _PERCENTILES)
    black, white = float(np.floor(10 * low)) / 10 + 0.0, float(np.ceil(10 * high)) / 10 + 0.0
    return black, max(white, round(black + 0.1, 1))


def importance_map(importance: Array) -> Image.Image:
    """Return a log-importance (H, W, 1) in gray, between the values of `importance_range`."""
    low, high = importance_range(importance)
    gray = np.rint(255 * np.clip((importance[..., 0] - low) / (high - low), 0, 1)).astype(np.uint8)
    return Image.fromarray(gray).convert("RGB")


def kernel_pictures(layers: Mapping[str, Array], exposure: float) -> dict[str, Image.Image]:
    """Return the picture of every layer, in its size.

    Args:
        layers: `kernel03_filtered` (H, W, 3), radiance; `kernel03_weight`, `x1_alpha` (H, W, 1), shares;
            `kernel03_importance` (H, W, 1).
        exposure: Factor that brings radiance to a displayable level.

    Returns:
        Name → picture; names of importance end with the values of black and white, `…_-8.1_to_2.4`.
    """
    made = {}
    for name, layer in layers.items():
        if name.endswith(FILTERED):
            made[name] = tone_map(layer, exposure)
        elif name.endswith(IMPORTANCE):
            low, high = importance_range(layer)
            made[f"{name}_{low:.1f}_to_{high:.1f}"] = importance_map(layer)
        else:
            made[name] = false_color(layer[..., 0])
    return made


def fusion_sheet(
    images: Mapping[str, Array], layers: Mapping[str, Array], exposure: float, label: str = ""
) -> Image.Image:
    """Return one picture: the images, and below a column for each kernel.

    Args:
        images: Title → radiance (H, W, 3), such as the input, the fused image and the reference.
        layers: As for `kernel_pictures`.
        exposure: Factor that brings radiance to a displayable level.
        label: Of the frame.
    """
    kernels = kernels_of(layers)
    top = [Panel(sized(tone_map(image, exposure)), title) for title, image in images.items()]
    size = top[0].picture.size
    rows: list[list[Panel]] = [top, [], [], []]
    for kernel in kernels:
        filtered, weight, importance = (layers[f"{kernel.name}_{part}"] for part in PARTS)
        rows[1].append(Panel(sized(tone_map(filtered, exposure)), f"{kernel.title} alone"))
        mean = f"mean {float(weight.mean(dtype=np.float64)):.3f}"
        rows[2].append(Panel(sized(false_color(weight[..., 0])), f"weight of {kernel.title}", mean))
        low, high = importance_range(importance)
        shown = f"black {low:.1f}, white {high:.1f}"
        rows[3].append(Panel(sized(importance_map(importance)), f"log-importance, {kernel.title}", shown))
    rows[2].append(Panel(legend(size, 1.0, ("fusion weight,", "sum over kernels 1"), more=False)))
    rows[3].append(Panel(_gray_bar(size)))
    if shares := _shares(layers, kernels, size):
        rows.append([*shares, Panel(legend(size, 1.0, ("share of the", "coarser result"), more=False))])
    return grid(rows, f"{label}, exposure {exposure:.4g}" if label else f"exposure {exposure:.4g}")


def _shares(layers: Mapping[str, Array], kernels: list[Kernel], size: tuple[int, int]) -> list[Panel]:
    """Return the shares of coarser results, each below the first kernel of its resolution."""
    blank, shares, seen = Panel(Image.new("RGB", size, _BACKGROUND)), [], set()
    for kernel in kernels:
        share = layers.get(f"x{kernel.factor}_{ALPHA}")
        if share is None or kernel.factor in seen:
            shares.append(blank)
            continue
        seen.add(kernel.factor)
        title = f"share of 1/{2 * kernel.factor}" + (f" in 1/{kernel.factor}" if kernel.factor > 1 else "")
        mean = f"mean {float(share.mean(dtype=np.float64)):.3f}"
        shares.append(Panel(sized(false_color(share[..., 0])), title, mean))
    return shares if seen else []


def _gray_bar(size: tuple[int, int]) -> Image.Image:
    """Return the grays of importance, upright, as large as a panel."""
    picture, margin = Image.new("RGB", size, _BACKGROUND), 12
    ramp = np.linspace(255, 0, size[1] - 2 * margin).astype(np.uint8)
    picture.paste(Image.fromarray(np.repeat(ramp[:, None], 22, axis=1)), (2, margin))
    draw = ImageDraw.Draw(picture)
    for text, y in (("99th percentile", margin), ("1st percentile", size[1] - margin)):
        draw.line([(24, y), (29, y)], _FAINT)
        draw.text((34, y), text, _FAINT, font(14), anchor="lm")
    return picture
