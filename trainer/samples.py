"""Frames that keep their samples apart, for `trainer denoise`: samples as tensors, layers as pictures."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from data.frame import Frame
from models.layers import Layer
from models.ops.per_sample import arranged, sample_counts
from trainer.configs import UsageError
from trainer.loading import Loaded, Model

if TYPE_CHECKING:
    from PIL.Image import Image

    from trainer.denoising import Result


def sample_tensor(frame: Frame, model: Model) -> Tensor:
    """Return the samples of a frame as a model reads them, (1, S, C, H, W).

    Raises:
        ValueError: The frame keeps no samples apart, or they lack a quantity that the model reads; names it.
    """
    if frame.samples is None:
        raise ValueError(
            f"{frame.label}: {type(model).__name__} reads the samples of each pixel, which the frame does "
            "not keep apart; expected channels such as s00.radiance.R, see trainer render --help"
        )
    values = torch.from_numpy(frame.samples.values).permute(0, 3, 1, 2)[None]
    try:
        return arranged(values, frame.samples.channels, model.samples, model.fill).contiguous()
    except ValueError as error:
        raise ValueError(f"{frame.label}: {error}") from None


def dropped(samples: Tensor) -> str | None:
    """Return how many samples do not count, and pixels without any, in one sentence; None where all count.

    Args:
        samples: (B, S, C, H, W).
    """
    counts, held = sample_counts(samples), samples.shape[1]
    lost = int(held * counts.numel() - counts.sum())
    if not lost:
        return None
    pixels, empty = int((counts < held).sum()), int((counts == 0).sum())
    text = f"{lost} samples with NaN or Inf in {pixels} pixels were dropped"
    return f"{text}; {empty} pixels had no other and were filled from around them" if empty else text


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
    from trainer.reports.layers import layer_picture
    from trainer.reports.pictures import Panel, grid, sized, tone_map

    pictures = {name: layer_picture(name, layer, result.exposure) for name, layer in result.aux.items()}
    composite = tone_map(result.frame.buffers["color"], result.exposure)
    rows: dict[str, list[Panel]] = {}
    for name, picture in pictures.items():
        layer, _, what = name.partition("_")
        number = re.sub(r"\D", "", layer)
        rows.setdefault(layer, []).append(Panel(sized(picture), f"layer {number}, {what}"))
    last = [Panel(sized(tone_map(result.noisy, result.exposure)), "input, mean of the samples")]
    last.append(Panel(sized(composite), "composite", f"exposure {result.exposure:.4g}"))
    sheet = grid([*rows.values(), last], result.frame.label)
    return {**pictures, "composite": composite, "layers": sheet}
