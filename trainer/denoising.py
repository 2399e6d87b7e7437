"""Frames in, denoised frames out: what `trainer denoise` does to each frame of a clip.

Derive what is missing, choose the exposure, accumulate where the model was trained so, denoise in tiles that
fit the memory budget. On request the attention of one pixel is looked at as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from data.buffers import SAMPLES, buffer
from data.derive import automatic_exposure, derive
from data.frame import Frame, Image
from data.temporal import Accumulator
from models.denoiser import Denoiser
from models.tiling import denoise_tiled
from trainer.attention import Attention, attention_of, attentive, inside
from trainer.clips import Clip
from trainer.export.description import DISTRIBUTION, installed_version
from trainer.loading import Loaded
from trainer.samples import LayerImages, dropped, layers_of, sample_tensor, with_layers


@dataclass(frozen=True)
class Settings:
    """How to denoise.

    Attributes:
        exposure: A factor, or None: the frame's own, measured where it has none.
        measure_exposure: Measure the exposure even where the frame has one.
        accumulate: Accumulate sequences where the model expects it.
        memory: Bytes that one call of the model may take; larger images are tiled.
        device: Where to run.
        attention: Column and row of the pixel whose attention is wanted.
        layers: Whether the layers of the model are wanted.
    """

    exposure: float | None = None
    measure_exposure: bool = False
    accumulate: bool = True
    memory: int = 2 * 1024**3
    device: str = "cpu"
    attention: tuple[int, int] | None = None
    layers: bool = False


@dataclass(frozen=True)
class Result:
    """A denoised frame.

    Attributes:
        frame: With the single buffer `color`, in the units of the input.
        exposure: The exposure that was used.
        noisy: Radiance of the frame alone (H, W, 3).
        accumulated: Radiance accumulated over the preceding frames, None where that was not done.
        reference: Converged radiance, None where the frame has none.
        attention: Of the pixel that the settings name, None where they name none.
        layers: What became of the layers, None where that is not wanted.
    """

    frame: Frame
    exposure: float
    noisy: Image
    accumulated: Image | None
    reference: Image | None
    attention: Attention | None = None
    layers: LayerImages | None = None


def replaced_pixels(frame: Frame) -> str | None:
    """Return which pixels of a frame are not what its file holds, in one sentence; None where all are.

    From `notes["repaired"]`, pixels that were NaN or Inf, and `notes["outside_data_window"]`.
    """
    parts = []
    for name, number in frame.notes.get("repaired", {}).items():
        if name == SAMPLES:
            parts.append(
                f"{number} values of samples were NaN or Inf, replaced by those of rays that hit nothing"
            )
            continue
        neighbours = buffer(name).repair == "neighbours"
        by = "the mean of their finite neighbours, 0 where there are none" if neighbours else _no_hit(name)
        parts.append(f"{_pixels(number, name)} NaN or Inf, replaced by {by}")
    for name, number in frame.notes.get("outside_data_window", {}).items():
        parts.append(f"{_pixels(number, name)} outside of the data window, replaced by {_no_hit(name)}")
    return "; ".join(parts) or None


def _pixels(number: int, name: str) -> str:
    return f"{number} pixel{'s' * (number != 1)} of {name} {'was' if number == 1 else 'were'}"


def _no_hit(name: str) -> str:
    return f"{buffer(name).no_hit:g}, the value of a pixel that hit nothing"


class ClipDenoiser:
    """Denoises the frames of one clip in order.

    Args:
        loaded: The model.
        clip: Whose frames will come.
        settings: How.
        say: Called with each remark for the user; the caller may show each only once.

    Raises:
        ValueError: Attention or layers are wanted and the model has none to look at.
    """

    def __init__(self, loaded: Loaded, clip: Clip, settings: Settings, say: Callable[[str], None]) -> None:
        self.loaded = loaded
        self.model = loaded.model.deploy().eval()
        if settings.attention is not None:
            attentive(loaded.model, loaded.source.reference)
        if settings.layers:
            with_layers(loaded.model, loaded.source.reference)
        self.clip = clip
        self.settings = settings
        self.say = say
        self._accumulator = Accumulator(**clip.thresholds)
        self._last: Frame | None = None
        self._exposure = 1.0

    def step(self, frame: Frame) -> Result:
        """Denoise the next frame.

        Raises:
            ValueError: A buffer is missing and cannot be derived, the pixel whose attention is wanted lies
                outside of the frame, or the model returned NaN or Inf.
        """
        if self.settings.attention is not None:
            inside(self.settings.attention, frame.width, frame.height)
        follows = self._follows(frame)
        previous = self._last.camera if follows and self._last is not None else None
        frame.notes["sequence"] = self.clip.sequence
        frame = derive(frame, self._wanted(frame), depth_kind=self.clip.depth, previous=previous)
        exposure = self._choose_exposure(frame, follows)
        self._last = frame
        noisy = self._noisy(frame)
        frame = self._accumulated(frame)
        buffers = self._tensors(frame, exposure)
        with torch.inference_mode():
            denoised = denoise_tiled(self.model, buffers, budget=self.settings.memory)
        color = np.ascontiguousarray(denoised[0].float().cpu().numpy().transpose(1, 2, 0))
        if not np.isfinite(color).all():
            raise ValueError(
                f"{frame.label}: the model returned NaN or Inf; train it again or report the frame"
            )
        result = replace(
            frame,
            buffers={"color": color},
            exposure=exposure,
            accumulated=False,
            notes=self._provenance(exposure),
            samples=None,
        )
        return Result(
            result,
            exposure,
            noisy,
            self._noisy(frame) if frame.accumulated else None,
            frame.buffers.get("reference"),
            self._attention(buffers),
            self._layers(buffers),
        )

    def _follows(self, frame: Frame) -> bool:
        last = self._last
        return (
            self.clip.sequence
            and last is not None
            and (last.scene, last.index + 1) == (frame.scene, frame.index)
        )

    def _wanted(self, frame: Frame) -> list[str]:
        names = [name for name in self.model.inputs if name != SAMPLES]
        temporal = self._accumulates(frame)
        return [*names, "irradiance", "albedo"] if temporal else names

    def _accumulates(self, frame: Frame) -> bool:
        """Whether this frame will be accumulated; says why not where the model expects it."""
        if not self.model.temporal or not self.settings.accumulate or frame.accumulated:
            return False
        if not self.clip.sequence:
            self.say("the frames are independent views: denoised without temporal accumulation")
            return False
        if len(self.clip.items) == 1:
            self.say("a single frame: denoised without temporal accumulation, which this model expects")
            return False
        if "motion" not in frame.buffers and ("position" not in frame.buffers or frame.camera is None):
            self.say(
                "the frames have neither motion nor position and camera: denoised without temporal "
                "accumulation, which this model expects"
            )
            return False
        return True

    def _accumulated(self, frame: Frame) -> Frame:
        if not self._accumulates(frame):
            return frame
        result = self._accumulator.step(frame)
        if "color" in self.model.inputs:
            color = result.buffers["irradiance"] * result.buffers["albedo"]
            result = result.with_buffers(color=color)
        return result

    def _choose_exposure(self, frame: Frame, follows: bool) -> float:
        if self.settings.exposure is not None:
            return self.settings.exposure
        if frame.exposure is not None and not self.settings.measure_exposure:
            return frame.exposure
        if not follows:  # one exposure for a whole sequence: a new one per frame would flicker
            self._exposure = automatic_exposure(self._noisy(frame))
        return self._exposure

    def _noisy(self, frame: Frame) -> Image:
        if "color" in frame.buffers and not frame.accumulated:
            return frame.buffers["color"]
        if {"irradiance", "albedo"} <= frame.buffers.keys():
            return frame.buffers["irradiance"] * frame.buffers["albedo"]
        return derive(frame, ["color"]).buffers["color"]

    def _tensors(self, frame: Frame, exposure: float) -> dict[str, Tensor]:
        names = [name for name in self.model.inputs if name != SAMPLES]
        frame.require(*names)
        buffers: dict[str, Tensor] = {
            name: torch.from_numpy(np.ascontiguousarray(frame.buffers[name].transpose(2, 0, 1)))[None]
            for name in names
        }
        if SAMPLES in self.model.inputs:
            assert isinstance(self.model, Denoiser)
            buffers[SAMPLES] = sample_tensor(frame, self.model)
            if lost := dropped(buffers[SAMPLES]):
                self.say(f"{frame.label}: {lost}")
        buffers = {name: value.to(self.settings.device) for name, value in buffers.items()}
        if "exposure" in self.model.frame_numbers:
            buffers["exposure"] = torch.tensor([exposure], dtype=torch.float32, device=self.settings.device)
        return buffers

    def _attention(self, buffers: dict[str, Tensor]) -> Attention | None:
        if self.settings.attention is None:
            return None
        model = attentive(self.loaded.model, self.loaded.source.reference)
        return attention_of(model, buffers, self.settings.attention)

    def _layers(self, buffers: dict[str, Tensor]) -> LayerImages | None:
        if not self.settings.layers:
            return None
        model = with_layers(self.model, self.loaded.source.reference)
        return layers_of(model, buffers, self.settings.memory)

    def _provenance(self, exposure: float) -> dict[str, Any]:
        model = self.loaded.model
        facts = {
            "model": self.loaded.source.reference,
            "class": type(model).__name__ if isinstance(model, Denoiser) else model.description.model,
            "exposure": exposure,
            DISTRIBUTION: installed_version(DISTRIBUTION),
        }
        return {"denoised": facts}
