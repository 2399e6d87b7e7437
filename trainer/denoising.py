"""Frames in, denoised frames out: what `trainer denoise` does to each frame of a clip.

Derive what is missing, choose the exposure, accumulate where the model was trained so, denoise in tiles that
fit the memory budget. On request the attention of one pixel is looked at as well. Space-time methods see
several frames at once: `trainer.sequences`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from data.buffers import SAMPLES, THIN_LENS
from data.derive import automatic_exposure, derive
from data.dropped import Dropped
from data.frame import Frame, Image
from data.temporal import Accumulator
from models.denoiser import Denoiser, State
from models.pace import Pace
from models.tiling import Run, denoise_in_tiles
from trainer.attention import Attention, attention_of, attentive, inside
from trainer.clips import Clip, Item
from trainer.export.description import DISTRIBUTION, installed_version
from trainer.inputs import Fitting, Say, advice
from trainer.loading import Loaded, Model
from trainer.samples import dropped, filled, sample_tensor

LARGE, SAMPLE = 20_000, 32
"""Pixels of all frames above which the time of steps is measured first, and on how large a corner."""


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
        tile: Largest side of a tile in pixels; None: only the memory limits it.
        run: Calls the model on a tile; None: here and now.
        finite: Refuse results that hold NaN or Inf.
    """

    exposure: float | None = None
    measure_exposure: bool = False
    accumulate: bool = True
    memory: int = 2 * 1024**3
    device: str = "cpu"
    attention: tuple[int, int] | None = None
    tile: int | None = None
    run: Run | None = None
    finite: bool = True


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
        aux: What the method made on its way (H, W, C), by layer or buffer; empty where it was not asked for.
    """

    frame: Frame
    exposure: float
    noisy: Image
    accumulated: Image | None
    reference: Image | None
    attention: Attention | None = None
    aux: Mapping[str, Image] = field(default_factory=dict)


@dataclass(frozen=True)
class Prepared:
    """A frame with all that the model reads.

    Attributes:
        frame: With derived, and where the model expects it accumulated, buffers.
        exposure: To denoise it with.
        noisy: Radiance of the frame alone (H, W, 3).
        follows: Whether it is the successor of the frame before.
        model: The form of the model that does with its buffers.
        reasons: Why that is not the one that was asked for.
    """

    frame: Frame
    exposure: float
    noisy: Image
    follows: bool
    model: Model
    reasons: tuple[str, ...]


class ClipDenoiser:
    """Denoises the frames of one clip in order.

    Args:
        loaded: The model.
        clip: Whose frames will come.
        settings: How.
        say: Called with each remark for the user; the caller may show each only once.
        progress: Called with the number of frames, a fraction, by which the work went on.

    Raises:
        ValueError: Attention is wanted and the model has none to look at.
    """

    def __init__(
        self,
        loaded: Loaded,
        clip: Clip,
        settings: Settings,
        say: Say,
        progress: Callable[[float], None] = lambda frames: None,
    ) -> None:
        self.loaded = loaded
        self.model = loaded.deployed
        if settings.attention is not None:
            attentive(loaded.model, loaded.source.reference)
        self.clip = clip
        self.settings = settings
        self.say = say
        self.progress = progress
        self._fitting = Fitting(self.model, settings.device, say)
        self._accumulator = Accumulator(**clip.thresholds)
        self._paces: dict[tuple[int, ...], Pace] = {}
        self._last: Frame | None = None
        self._exposure = 1.0
        self._state: State | None = None
        self._size: tuple[int, ...] = ()

    def push(self, item: Item, frame: Frame) -> Iterable[tuple[Item, Result]]:
        """Take the next frame and return what is finished with it.

        Raises:
            ValueError: As `step`.
        """
        return [(item, self.step(frame))]

    def finish(self) -> Iterable[tuple[Item, Result]]:
        """Return what is left after the last frame."""
        return ()

    def step(self, frame: Frame) -> Result:
        """Denoise the next frame.

        Raises:
            ValueError: A buffer is missing and cannot be derived, the pixel whose attention is wanted lies
                outside of the frame, or the model returned NaN or Inf.
        """
        prepared = self.prepare(frame)
        buffers = self.tensors(prepared)
        done = 0.0

        def advance(share: float) -> None:
            nonlocal done
            self.progress(share - done)
            done = share

        carried, self._state = self._carried(prepared, buffers), None
        with torch.inference_mode():
            denoised = denoise_in_tiles(
                prepared.model,
                buffers,
                tile=self.settings.tile,
                budget=self.settings.memory,
                progress=advance,
                pace=self.pace(prepared.model, buffers),
                run=self.settings.run,
                state=carried,
            )
        if torch.isfinite(denoised.color).all():  # what is no number would spoil all later frames
            self._state = denoised.state
        aux = {name: image[0] for name, image in (denoised.aux or {}).items()}
        return self.result(prepared, denoised.color[0], aux, self._attention(buffers))

    def _carried(self, prepared: Prepared, buffers: Mapping[str, Tensor]) -> State | None:
        """Return the state of the frame before; None where this one does not follow it."""
        sizes = tuple(buffers[prepared.model.inputs[0]].shape)
        first, follows = not self._size, prepared.follows and sizes == self._size
        self._size = sizes
        if getattr(prepared.model, "recurrent", False):
            name, clip, label = self.loaded.source.reference, self.clip, prepared.frame.label
            if not clip.sequence:
                self.say(f"the frames are independent views: {name} denoises each as the first of a sequence")
            elif len(clip.items) == 1:
                self.say(f"a single frame: {name} denoises it as the first of a sequence")
            elif not (first or follows):
                self.say(f"{label} does not go on from the frame before: {name} starts a new sequence there")
        return self._state if follows else None

    def pace(self, model: Model, buffers: Mapping[str, Tensor]) -> Pace | None:
        """Return when the steps of a method come, None for images so small that it does not matter.

        None too where the model is called elsewhere. Measured on a corner of the first image or sequence
        of its length.
        """
        first = buffers[model.inputs[0]]
        elsewhere = self.settings.run is not None
        if elsewhere or not hasattr(model, "fused") or first[0, ..., 0, :, :].numel() < LARGE:
            return None
        key = (id(model), *first.shape[:-2])
        if key not in self._paces:
            side = -(-SAMPLE // model.multiple) * model.multiple
            corner = {n: t[..., :side, :side] if n in model.inputs else t for n, t in buffers.items()}
            corner = {n: t.contiguous() for n, t in corner.items()}
            call = model.clip if isinstance(model, Denoiser) and model.frames else model
            self._paces[key] = Pace(lambda: call(corner))
        return self._paces[key]

    def prepare(self, frame: Frame) -> Prepared:
        """Return the next frame with all that the model reads; raises as `step`."""
        if self.settings.attention is not None:
            inside(self.settings.attention, frame.width, frame.height)
        follows = self._follows(frame)
        previous = self._last.camera if follows and self._last is not None else None
        frame.notes["sequence"] = self.clip.sequence
        if not follows:
            frame = self._unmoved(frame)
        model, reasons = self._fitting.fit(frame, self.clip.depth, previous)
        try:
            frame = derive(frame, self._wanted(frame, model), depth_kind=self.clip.depth, previous=previous)
        except ValueError as error:
            hint = advice(model, self._fitting.has(frame, self.clip.depth, previous))
            if not hint or hint in str(error):
                raise
            raise ValueError(f"{error}; {hint}") from error
        exposure = self._choose_exposure(frame, follows)
        self._last = frame
        noisy = self._noisy(frame)
        return Prepared(self._accumulated(frame), exposure, noisy, follows, model, reasons)

    def result(
        self,
        prepared: Prepared,
        color: Tensor,
        aux: Mapping[str, Tensor],
        attention: Attention | None = None,
    ) -> Result:
        """Return the result of a frame from what the model made of it, (C, H, W) each.

        Raises:
            ValueError: The model returned NaN or Inf.
        """
        frame, image = prepared.frame, _image(color)
        if self.settings.finite and not np.isfinite(image).all():
            raise ValueError(
                f"{frame.label}: the model returned NaN or Inf; train it again or report the frame"
            )
        denoised = replace(
            frame,
            buffers={"color": image},
            exposure=prepared.exposure,
            accumulated=False,
            notes=self._provenance(prepared),
            samples=None,
        )
        return Result(
            denoised,
            prepared.exposure,
            prepared.noisy,
            self._noisy(frame) if frame.accumulated else None,
            frame.buffers.get("reference"),
            attention,
            {name: _image(layer) for name, layer in aux.items()},
        )

    def _unmoved(self, frame: Frame) -> Frame:
        """Return the first frame of a sequence with motion 0, where a recurrent method reads motion."""
        lacking = {*self.model.inputs} - frame.buffers.keys()
        if getattr(self.model, "recurrent", False) and "motion" in lacking:
            return frame.with_buffers(motion=np.zeros((frame.height, frame.width, 2), np.float32))
        return frame

    def _follows(self, frame: Frame) -> bool:
        return self.clip.sequence and frame.follows(self._last)

    def _wanted(self, frame: Frame, model: Model) -> list[str]:
        names = [name for name in model.inputs if name != SAMPLES]
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

    def tensors(self, prepared: Prepared) -> dict[str, Tensor]:
        """Return what the model reads of a frame: buffers (1, C, H, W), samples, and the exposure."""
        frame, model = prepared.frame, prepared.model
        names = [name for name in model.inputs if name != SAMPLES]
        frame.require(*names)
        buffers: dict[str, Tensor] = {
            name: torch.from_numpy(np.ascontiguousarray(frame.buffers[name].transpose(2, 0, 1)))[None]
            for name in names
        }
        if SAMPLES in model.inputs:
            buffers[SAMPLES] = sample_tensor(frame, model)
            if lost := dropped(buffers[SAMPLES]):
                frame.notes["dropped"] = list(lost)
        if "dropped" in frame.notes:
            self.say(f"{frame.label}: {Dropped(*frame.notes['dropped']).text()}", "warning")
        numbers = {"exposure": (prepared.exposure,), THIN_LENS: frame.thin_lens}
        for name in model.frame_numbers:
            if (number := numbers.get(name)) is not None:
                value = torch.tensor(number, dtype=torch.float32)
                buffers[name] = value if len(number) == 1 else value[None]
        return {name: value.to(self.settings.device) for name, value in buffers.items()}

    def _attention(self, buffers: dict[str, Tensor]) -> Attention | None:
        if self.settings.attention is None:
            return None
        model = attentive(self.loaded.model, self.loaded.source.reference)
        return attention_of(model, buffers, self.settings.attention)

    def _provenance(self, prepared: Prepared) -> dict[str, Any]:
        model, source = self.loaded.model, self.loaded.source
        facts = {
            "model": source.reference,
            "class": type(model).__name__ if isinstance(model, Denoiser) else model.description.model,
            "exposure": prepared.exposure,
            DISTRIBUTION: installed_version(DISTRIBUTION),
        }
        if isinstance(model, Denoiser) and source.class_path and not source.sha256 and source.init_args:
            facts["options"] = source.init_args
        if model.per_sample and (constants := filled(prepared.frame, prepared.model)):
            facts["filled"] = constants
        if "dropped" in prepared.frame.notes:
            facts["dropped"] = Dropped(*prepared.frame.notes["dropped"])._asdict()
        if prepared.reasons:
            facts["instead"] = list(prepared.reasons)
        return {"denoised": facts}


def _image(tensor: Tensor) -> Image:
    return np.ascontiguousarray(tensor.float().cpu().numpy().transpose(1, 2, 0))
