"""Metrics of one denoised frame, from the pictures that a worker wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from data.exr_image import read_exr
from trainer.evaluation.plan import PLACES, REFERENCE, Method, Setting
from trainer.metrics.measures import SCORES
from trainer.metrics.sharing import shared
from trainer.metrics.temporal import change_gamma, flicker_gamma


@dataclass(frozen=True)
class Question:
    """Which frame is scored.

    Attributes:
        images: Folder of all images.
        folder: The method's own below it.
        name: Of the frame, `SCENE/fNNN`.
        before: Of the preceding frame of its sequence; None where there is none.
        exposure: At which it is judged.
        metrics: Names of `SCORES`.
        reference: Whether it has a reference.
    """

    images: str
    folder: str
    name: str
    before: str | None
    exposure: float
    metrics: tuple[str, ...]
    reference: bool = True


def question_of(setting: Setting, method: Method, row: Mapping[str, Any]) -> Question:
    """Return what is scored of a frame that a worker told of."""
    name = row["name"]
    return Question(
        str(setting.folder / "images"),
        method.folder,
        name,
        setting.names[name],
        setting.exposures.get(name, row["exposure"]),
        setting.metrics,
        row["reference"],
    )


def score(question: Question) -> dict[str, float]:
    """Return metric → value; NaN where the frame has no reference, is too small, or holds NaN.

    Raises:
        OSError: A picture is missing.
        ValueError: A picture is damaged, or has another size than its reference.
    """
    torch.set_num_threads(1)
    root = Path(question.images)
    empty = dict.fromkeys(question.metrics, math.nan)
    target = root / REFERENCE / f"{question.name}.exr"
    if not question.reference:
        return empty
    output = load(root / question.folder / f"{question.name}.exr") * question.exposure
    reference = load(target) * question.exposure
    if output.shape != reference.shape:
        sizes = [f"{image.shape[2]}x{image.shape[1]}" for image in (output, reference)]
        raise ValueError(f"{question.name} is {sizes[0]}, its reference {sizes[1]}")
    if not torch.isfinite(output).all():
        return empty
    return empty | _still(output, reference, question.metrics) | _moving(question, output, reference)


def load(path: Path) -> Tensor:
    """Return the radiance (3, H, W) in an EXR file of an evaluation; raises as `data.exr_image.read_exr`."""
    image = read_exr(path)
    return torch.from_numpy(np.stack([image.channels[letter] for letter in "RGB"]))


def _still(output: Tensor, reference: Tensor, metrics: Sequence[str]) -> dict[str, float]:
    values, pair = {}, (output[None], reference[None])
    with shared():
        for name in metrics:
            function = SCORES[name].function
            if function is None:
                continue
            try:
                values[name] = float(function(*pair))
            except ValueError:
                values[name] = math.nan  # the image is smaller than the window
    return values


def _moving(question: Question, output: Tensor, reference: Tensor) -> dict[str, float]:
    root, before = Path(question.images), question.before
    path = root / PLACES / f"{question.name}.npz"
    if before is None or not path.is_file() or not {"change_gamma", "flicker_gamma"} & {*question.metrics}:
        return {}
    last = load(root / question.folder / f"{before}.exr") * question.exposure
    if not torch.isfinite(last).all():
        return {}
    with np.load(path, allow_pickle=False) as stored:
        places = stored["places"]
    wanted = {"change_gamma": change_gamma(output, last, places)}
    target = root / REFERENCE / f"{before}.exr"
    if target.is_file():
        reference_before = load(target) * question.exposure
        wanted["flicker_gamma"] = flicker_gamma(output, last, reference, reference_before, places)
    return {name: value for name, value in wanted.items() if name in question.metrics}
