"""Sheet of the layers that samples were sorted into, after figure 5 of Munkberg and Hasselgren 2020."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from trainer.reports.layers import layer_picture
from trainer.reports.pictures import Array, Panel, grid, sized, tone_map

if TYPE_CHECKING:
    from PIL import Image

PARTS = ("unfiltered", "alpha", "filtered")
"""What is shown of each layer, `layer<number>_<part>`."""


def is_layered(aux: Mapping[str, Array]) -> bool:
    """Return whether a method returned layers, and nothing else, as what it made on its way."""
    return bool(aux) and all(name.startswith("layer") and name.endswith(PARTS) for name in aux)


def composite_sheet(
    images: Mapping[str, Array], layers: Mapping[str, Array], exposure: float, label: str = ""
) -> Image.Image:
    """Return one picture of the images, above a row for each layer, the front one first.

    Args:
        images: Title → radiance (H, W, 3), such as the input, the composite and the reference.
        layers: `layer0_unfiltered`, `layer0_alpha`, `layer0_filtered`, `layer1_unfiltered` …: radiance
            (H, W, 3), or a share in [0, 1], (H, W, 1).
        exposure: Factor that brings radiance to a displayable level.
        label: Of the frame.
    """
    rows = [[Panel(sized(tone_map(image, exposure)), title) for title, image in images.items()]]
    count = len({name.partition("_")[0] for name in layers})
    total = sum(float(layer.mean()) for name, layer in layers.items() if name.endswith("_unfiltered"))
    for number in range(count):
        row = []
        for part in PARTS:
            layer = layers[f"layer{number}_{part}"]
            picture = sized(layer_picture(part, layer, exposure))
            row.append(Panel(picture, f"{_place(number, count)}, {part}", _caption(part, layer, total)))
        rows.append(row)
    return grid(rows, f"{label}, exposure {exposure:.4g}" if label else f"exposure {exposure:.4g}")


def _place(number: int, count: int) -> str:
    place = {0: " (front)", count - 1: " (back)"}.get(number, "") if count > 1 else ""
    return f"layer {number}{place}"


def _caption(part: str, layer: Array, total: float) -> str:
    """Return what a panel shows: dark pictures of layers are meant, since they are weighted."""
    mean = float(layer.mean())
    if part == "unfiltered":
        return f"times its weight: {100 * mean / total:.3g}% of the light" if total > 0 else "black"
    if part == "alpha":
        return f"white: opaque; mean {mean:.2f}"
    return "times its weight, then filtered"
