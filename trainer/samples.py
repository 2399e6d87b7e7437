"""Frames that keep their samples apart, for `trainer denoise`: samples as tensors, layers as pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from data.buffers import SAMPLES
from data.frame import Frame
from models.denoiser import Denoiser
from models.layers import Layer, Layered
from models.ops.per_sample import arranged, sample_counts
from models.tiling import aligned_halo, core_size, numbers_of_frame, tiles
from trainer.reports.pictures import tone_map

Radiance = NDArray[np.float32]


@dataclass(frozen=True)
class LayerImages:
    """What became of the layers of one frame.

    Attributes:
        unfiltered: Radiance of each layer before filtering (L, H, W, 3), in the units of the input.
        filtered: After filtering, weighted by alpha.
        alpha: Opacity of each layer (L, H, W), 0 to 1.
        composite: The image (H, W, 3).
    """

    unfiltered: Radiance
    filtered: Radiance
    alpha: Radiance
    composite: Radiance

    def pictures(self, exposure: float) -> dict[str, Image.Image]:
        """Return name → picture: `layer0-unfiltered`, `layer0-filtered`, `layer0-alpha` …, `composite`."""
        made = {}
        for number in range(len(self.alpha)):
            made[f"layer{number}-unfiltered"] = tone_map(self.unfiltered[number], exposure)
            made[f"layer{number}-filtered"] = tone_map(self.filtered[number], exposure)
            gray = np.rint(np.clip(self.alpha[number], 0, 1) * 255).astype(np.uint8)
            made[f"layer{number}-alpha"] = Image.fromarray(gray)
        made["composite"] = tone_map(self.composite, exposure)
        return made


def sample_tensor(frame: Frame, model: Denoiser) -> Tensor:
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


def with_layers(model: Any, name: str) -> Layer:
    """Return the model if it has layers.

    Raises:
        ValueError: It has none.
    """
    if not isinstance(model, Layer):
        raise ValueError(f"--layers needs a model with layers (Layer, Optimized), and {name} has none")
    return model


@torch.inference_mode()
def layers_of(model: Layer, buffers: dict[str, Tensor], memory: int) -> LayerImages:
    """Return what becomes of the layers of one frame, in tiles that fit a memory budget.

    Args:
        model: A network with layers.
        buffers: `samples` (1, S, C, H, W) and frame numbers.
        memory: Bytes.
    """
    samples, numbers = buffers[SAMPLES], numbers_of_frame(model, buffers)
    height, width = samples.shape[-2:]
    bottom, right = -height % model.multiple, -width % model.multiple
    samples = torch.nn.functional.pad(samples, (0, right, 0, bottom), value=torch.nan)
    size = (height + bottom, width + right)
    whole: list[Tensor] = []
    for piece in tiles(*size, core_size(model, size, memory), aligned_halo(model)):
        part = samples[(..., *piece.read)].contiguous()
        made: Layered = model.layered({SAMPLES: part, **numbers})
        if not whole:
            whole = [image.new_empty(*image.shape[:-2], *size) for image in made]
        rows, columns = (
            slice(c.start - r.start, c.stop - r.start) for c, r in zip(piece.core, piece.read, strict=True)
        )
        for target, image in zip(whole, made, strict=True):
            target[(..., *piece.core)] = image[..., rows, columns]
    found = [_array(image[0, ..., :height, :width]) for image in whole]
    return LayerImages(found[0], found[1], found[2][..., 0], found[3])


def _array(image: Tensor) -> Radiance:
    """Return (…, H, W, C) of (…, C, H, W)."""
    return np.ascontiguousarray(image.float().movedim(-3, -1).cpu().numpy())
