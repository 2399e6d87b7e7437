"""Sheet of what a method made on its way: estimated errors, selection map, filtered features.

The selection map has the colours of figure 8 of Bitterli et al. 2016: red where the smaller bandwidth is
used, green where the larger one is, and what lies between where they are mixed. Shares of three candidates
have those of figure 3 there: red, green and blue.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from PIL import Image, ImageDraw

from data.buffers import BUFFERS
from trainer.reports.pictures import Array, Panel, false_color, font, grid, legend, sized, tone_map
from trainer.reports.thumbnails import picture_of

ERROR, SELECTION, SHARES = "error_", "selection", "shares"
"""How names of error maps begin, and the names of the maps of which of two, and of three, was selected."""

_SMALL, _LARGE = (0.85, 0.1, 0.1), (0.1, 0.72, 0.2)
_COLUMNS = 3
_BACKGROUND, _TEXT, _FAINT = (24, 24, 27), (236, 236, 238), (161, 161, 170)


def layer_sheet(color: Array, exposure: float, layers: Mapping[str, Array], label: str = "") -> Image.Image:
    """Return one picture of all layers.

    Args:
        color: The result, radiance (H, W, 3).
        exposure: Factor that brings radiance to a displayable level.
        layers: (H, W, C) each: `error_k0.5` and the like are squared errors in squared units of radiance,
            `selection` is a share in [0, 1], `shares` are three, others are buffers.
        label: Of the frame.
    """
    errors = {name: layer for name, layer in layers.items() if name.startswith(ERROR)}
    result = Panel(sized(tone_map(color, exposure)), "denoised", f"exposure {exposure:.4g}")
    size = result.picture.size
    rows = [[result]]
    if SELECTION in layers:
        rows[0] += _selection(layers[SELECTION], size, list(errors))
    if SHARES in layers:
        rows[0].append(_shares(layers[SHARES], list(errors)))
    if errors:
        rows.append(_errors(errors, exposure, size))
    rest = [_panel(n, x, exposure) for n, x in layers.items() if n not in {*errors, SELECTION, SHARES}]
    rows += [rest[i : i + _COLUMNS] for i in range(0, len(rest), _COLUMNS)]
    return grid(rows, label)


def selection_map(selection: Array) -> Image.Image:
    """Return the picture of a share (H, W, C): red 0, green 1; the mean of the channels."""
    share = np.clip(selection.mean(-1, keepdims=True), 0, 1)
    small, large = (np.array(c, np.float32) for c in (_SMALL, _LARGE))
    return Image.fromarray(np.rint(255 * (small + share * (large - small))).astype(np.uint8))


def _selection(selection: Array, size: tuple[int, int], errors: list[str]) -> list[Panel]:
    names = [name.removeprefix(ERROR).replace("k", "k = ", 1) for name in errors]
    small, large = names if len(names) == 2 else ("smaller bandwidth", "larger bandwidth")
    share = float(np.clip(selection, 0, 1).mean())
    map_ = Panel(sized(selection_map(selection)), "selection", f"{large} has {share:.0%} of the weight")
    return [map_, Panel(_bar(size, (small, large)))]


def _shares(shares: Array, errors: list[str]) -> Panel:
    """Return the picture of three shares (H, W, 3) whose sum is 1."""
    names = [name.removeprefix(ERROR) for name in errors] or ["first", "second", "third"]
    means = shares.reshape(-1, 3).mean(0)
    colors = zip(("red", "green", "blue"), names, means, strict=True)
    picture = Image.fromarray(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8))
    return Panel(
        sized(picture), SHARES, ", ".join(f"{name} {mean:.0%} {color}" for color, name, mean in colors)
    )


def _bar(size: tuple[int, int], ends: tuple[str, str]) -> Image.Image:
    """Return the colours of the selection map, upright, as large as a panel."""
    picture = Image.new("RGB", size, _BACKGROUND)
    draw, margin = ImageDraw.Draw(picture), 12
    ramp = np.linspace(1, 0, size[1] - 2 * margin, dtype=np.float32)[:, None, None]
    picture.paste(selection_map(np.repeat(ramp, 22, axis=1)), (2, margin))
    for text, y in ((ends[1], margin), ("both, half each", size[1] / 2), (ends[0], size[1] - margin)):
        draw.line([(24, y), (29, y)], _FAINT)
        draw.text((34, y), text, _FAINT, font(14), anchor="lm")
    return picture


def _errors(errors: Mapping[str, Array], exposure: float, size: tuple[int, int]) -> list[Panel]:
    """Return the error maps on one scale, and the scale."""
    roots = {n: exposure * np.sqrt(np.maximum(x.mean(-1), 0)).astype(np.float32) for n, x in errors.items()}
    top = _round_number(float(max(np.percentile(root, 98) for root in roots.values())))
    panels = []
    for name, root in roots.items():
        bandwidth = name.removeprefix(ERROR).replace("k", "k = ", 1)
        caption = f"root mean square {np.sqrt(np.square(root, dtype=np.float64).mean()):.3g}"
        panels.append(Panel(sized(false_color(root / top)), f"estimated error, {bandwidth}", caption))
    lines = ("root of the", "estimated MSE,", "exposed radiance")
    return [*panels, Panel(legend(size, top, lines))]


def _round_number(value: float) -> float:
    """Return the next of …, 0.1, 0.2, 0.5, 1, 2 … that is not smaller, 1 for 0."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-6)))


def _panel(name: str, layer: Array, exposure: float) -> Panel:
    if name in BUFFERS:
        picture, note = picture_of(name, layer, exposure)
        return Panel(sized(picture), f"{name}, filtered", note.replace("−", "-"))  # not in Pillow's font
    return Panel(sized(layer_picture(name, layer, exposure)), name.replace("_", ", "))


def layer_picture(name: str, layer: Array, exposure: float) -> Image.Image:
    """Return the picture of radiance (H, W, 3), or of a share in [0, 1], (H, W, 1), in gray.

    Raises:
        ValueError: It has another number of channels.
    """
    if layer.shape[-1] == 3:
        return tone_map(layer, exposure)
    if layer.shape[-1] != 1:
        raise ValueError(f"layer {name} has {layer.shape[-1]} channels; expected radiance or one share")
    return Image.fromarray(np.rint(np.clip(layer[..., 0], 0, 1) * 255).astype(np.uint8)).convert("RGB")
