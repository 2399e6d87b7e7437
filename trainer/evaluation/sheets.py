"""Pictures of an evaluation as files: for each scene one frame of every method, and their error maps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from trainer.evaluation.plan import INPUT, REFERENCE
from trainer.evaluation.running import Outcome
from trainer.evaluation.scores import load
from trainer.metrics.measures import SCORES
from trainer.outputs import replacing
from trainer.reports.pictures import Panel, error_map, grid, sized, tone_map

Array = NDArray[np.float32]
COLUMNS = 4
CAPTION = ("psnr_wskp", "flip_ldr_srgb")
"""Metrics that are written below a picture."""
_LABEL = 34


def write_sheets(folder: Path, rows: pd.DataFrame, outcomes: Sequence[Outcome]) -> list[Path]:
    """Write `pictures/SCENE.png` for the middle frame of each scene and return the files.

    Args:
        folder: Of the evaluation, with `images`.
        rows: One per frame and method.
        outcomes: Of the input and of all methods.

    Raises:
        OSError: A file cannot be read or written.
        ValueError: A picture is damaged.
    """
    place = folder / "pictures"
    place.mkdir(exist_ok=True)
    for old in place.glob("*.png"):
        old.unlink()
    written = []
    frames = rows[(rows["method"] == INPUT) & rows["scene"].notna()]
    for scene, own in frames.groupby("scene", sort=False):
        frame = own.iloc[len(own) // 2]
        picture = _sheet(folder / "images", frame, rows[rows["name"] == frame["name"]], outcomes)
        if picture is not None:
            path = place / (re.sub(r"[^\w.-]+", "-", str(scene)) + ".png")
            with replacing(path) as partial:
                picture.save(partial, "PNG")
            written.append(path)
    return written


def _sheet(images: Path, frame: Any, rows: pd.DataFrame, outcomes: Sequence[Outcome]) -> Image.Image | None:
    """Return a sheet of one frame; None where there is no picture of it."""
    exposure = float(frame["exposure"]) if pd.notna(frame["exposure"]) else 1.0
    target = _image(images / REFERENCE / f"{frame['name']}.exr")
    cells: list[tuple[Panel, Panel | None]] = []
    for outcome in outcomes:
        image = _image(images / outcome.method.folder / f"{frame['name']}.exr")
        if image is None:
            continue
        caption = _caption(rows[rows["method"] == outcome.method.label])
        shown = Panel(sized(tone_map(image, exposure)), outcome.method.label[:_LABEL], caption)
        compared = target is not None and target.shape == image.shape
        cells.append((shown, Panel(sized(error_map(image, target, exposure))) if compared else None))  # type: ignore[arg-type]
    if not cells:
        return None
    if target is not None:
        cells.append((Panel(sized(tone_map(target, exposure)), REFERENCE, "target"), None))
    spp = f", {int(frame['spp'])} spp" if pd.notna(frame["spp"]) else ""
    maps = "; below, differences of display values, mean of R, G, B, to 0.25" if target is not None else ""
    return grid(_rows(cells), f"{frame['name']}{spp}, exposure {exposure:.3g}{maps}")


def _rows(cells: Sequence[tuple[Panel, Panel | None]]) -> list[list[Panel]]:
    """Return the pictures in lines of `COLUMNS`, each with the line of their error maps below."""
    blank = Image.new("RGB", cells[0][0].picture.size)
    lines = []
    for start in range(0, len(cells), COLUMNS):
        part = cells[start : start + COLUMNS]
        lines.append([shown for shown, _ in part])
        if any(error is not None for _, error in part):
            lines.append([error or Panel(blank) for _, error in part])
    return lines


def _image(path: Path) -> Array | None:
    return load(path).movedim(0, -1).numpy() if path.is_file() else None


def _caption(rows: pd.DataFrame) -> str:
    if rows.empty:
        return ""
    row = rows.iloc[0]
    found = [name for name in CAPTION if name in row and pd.notna(row[name])]
    return ", ".join(f"{name} {SCORES[name].format.format(row[name])}" for name in found)
