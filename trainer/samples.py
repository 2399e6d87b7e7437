"""Frames that keep their samples apart, for `trainer denoise`: samples as tensors, layers as pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from data.buffers import SAMPLE_BUFFERS
from data.dropped import Dropped
from data.frame import Frame
from models.denoiser import Denoiser
from models.layers import Layer
from models.ops.per_sample import arranged, sample_counts
from trainer.configs import UsageError
from trainer.loading import Loaded, Model

if TYPE_CHECKING:
    from PIL.Image import Image

    from trainer.denoising import Result

LIGHT = ("radiance", "diffuse", "specular")
"""What is denoised: no constant stands for it."""


def sample_tensor(frame: Frame, model: Model) -> Tensor:
    """Return the samples of a frame as a model reads them, (1, S, C, H, W).

    Raises:
        ValueError: The frame keeps no samples apart, or they lack a quantity that the model reads; names it.
    """
    if frame.samples is None:
        name = type(model).__name__ if isinstance(model, Denoiser) else model.description.model
        raise ValueError(
            f"{frame.label}: {name} reads the samples of each pixel, which the frame does "
            "not keep apart; expected channels such as s00.radiance.R, see trainer render --help"
        )
    values = torch.from_numpy(frame.samples.values).permute(0, 3, 1, 2)[None]
    try:
        return arranged(values, frame.samples.channels, model.samples, model.fill).contiguous()
    except ValueError as error:
        lacking = [n for n in model.samples if n not in frame.samples.names and n not in model.fill]
        filling = " ".join(f"--fill {n}={SAMPLE_BUFFERS[n].no_hit:g}" for n in lacking if n not in LIGHT)
        raise ValueError(f"{frame.label}: {error}" + (f" ({filling})" if filling else "")) from None


def fill(model: Model, texts: Sequence[str]) -> None:
    """Set constants that stand for quantities where the samples of a frame lack them, beside the model's own.

    Args:
        model: A network or an exported file that reads samples.
        texts: `QUANTITY=VALUE`, such as `lens=0`.

    Raises:
        UsageError: The model reads no samples, or not this quantity, or the value is no number.
    """
    if not texts:
        return
    if not model.per_sample:
        raise UsageError(f"--fill {texts[0]}: the model reads no samples of each pixel, so nothing is filled")
    guides = [name for name in model.samples if name not in LIGHT]
    constants = dict(model.fill)
    for text in texts:
        name, _, value = text.partition("=")
        if name not in guides:
            raise UsageError(f"--fill {text}: expected QUANTITY=VALUE with one of {', '.join(guides)}")
        try:
            constants[name] = float(value)
        except ValueError:
            constants[name] = math.nan
        if not math.isfinite(constants[name]):
            raise UsageError(f"--fill {text}: {value!r} is no finite number; expected one, as in {name}=0")
    model.fill = constants


def filled(frame: Frame, model: Model) -> dict[str, float]:
    """Return the constants that stand for quantities which the samples of a frame lack."""
    held = () if frame.samples is None else frame.samples.names
    return {name: float(value) for name, value in model.fill.items() if name not in held}


def dropped(samples: Tensor) -> Dropped | None:
    """Return how many samples do not count, and pixels without any; None where all count.

    Args:
        samples: (B, S, C, H, W).
    """
    counts, held = sample_counts(samples), samples.shape[1]
    lost = int(held * counts.numel() - counts.sum())
    if not lost:
        return None
    return Dropped(lost, int((counts < held).sum()), int((counts == 0).sum()))


def return_layers(loaded: Loaded) -> None:
    """Let a model return its layers as `Denoised.aux`.

    Raises:
        UsageError: It has none.
    """
    if not isinstance(loaded.model, Layer):
        raise UsageError(
            f"--layers shows the layers of Layer and Optimized; {loaded.source.reference} is another method"
        )
    loaded.model.aux = True


def layer_pictures(result: Result) -> dict[str, Image]:
    """Return name → picture: `layer0_unfiltered`, `layer0_alpha`, `layer0_filtered` …, `composite`.

    And all of them on one sheet, `layers`, as in figure 5 of Munkberg and Hasselgren 2020.

    Args:
        result: With the layers of a `models.Layer` as `aux`.
    """
    from trainer.reports.composite import composite_sheet
    from trainer.reports.layers import layer_picture
    from trainer.reports.pictures import tone_map

    color = result.frame.buffers["color"]
    pictures = {name: layer_picture(name, layer, result.exposure) for name, layer in result.aux.items()}
    images = {"mean of the samples": result.noisy, "composite": color}
    if result.reference is not None:
        images["reference"] = result.reference
    sheet = composite_sheet(images, result.aux, result.exposure, result.frame.label)
    return {**pictures, "composite": tone_map(color, result.exposure), "layers": sheet}
