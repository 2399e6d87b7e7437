"""What one measured call does: denoise a batch of images, or take one step of training.

Images are made up with the ranges of renders (`trainer.export.entry.example`): no time depends on more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models.denoiser import Denoised, Denoiser, State
from models.tiling import denoise_in_tiles
from trainer.benchmarking.cases import Case, Method
from trainer.building import build, class_path_of, find_class
from trainer.export.artifact import Artifact
from trainer.export.entry import Sampled, example
from trainer.loading import Model, resolve
from trainer.losses import SMAPE
from trainer.options import parse

SMALL = 64
"""Side of the images on which libraries are loaded and kernels compiled before memory is measured."""

RATE = 1e-5
"""Learning rate: weights shall stay what they are."""


class Subject:
    """A method and its images, ready to be called.

    Args:
        case: The case.
        file: An exported form that stands for the model.

    Attributes:
        megapixels: That one call computes.
        mode: How it runs: that of the case, of an exported file its format.

    Raises:
        ValueError: The model cannot do what the case asks; says why.
    """

    def __init__(self, case: Case, file: Path | None = None) -> None:
        self.case = case
        torch.manual_seed(0)
        method = Method(str(file)) if file else case.method
        model = load(method, case.device)
        _check(model, case)
        self.mode = case.mode
        if isinstance(model, Artifact):  # also where only loading it shows that it is one
            self.mode = model.description.format
        self._step: _Training | _Inference
        if case.kind == "training":
            self._step = _Training(model, case)
        else:
            self._step = _Inference(model, case)
        frames = 2 * model.frames + 1 if model.frames else 1
        self.megapixels = case.batch * frames * case.width * case.height / 1e6
        # Compiled code is for one size; another would only be compiled beside it.
        self._small = None if case.mode == "compiled" else self._step.images(_smaller(case))
        self._images = self._step.images(case)

    def settle(self) -> None:
        """Load what a first call loads beside the memory of its images."""
        if self._small is not None:
            self._step(self._small)
        self.forget()

    def forget(self) -> None:
        """Release what calls leave behind: gradients and the optimiser's state, or that of the sequence."""
        self._small = None
        self._step.forget()

    def __call__(self) -> None:
        """Do it once."""
        self._step(self._images)


def load(method: Method, device: str) -> Model:
    """Return the model; one that is named by its class gets random weights where it has any.

    Raises:
        ValueError, FileNotFoundError: There is no such model, or it is damaged.
    """
    if not method.is_class:
        return resolve(method.model, device, options=method.options).model
    class_path = class_path_of(method.model)
    denoiser = build(class_path, parse(find_class(class_path), method.options))
    return denoiser.eval().requires_grad_(False).to(device)


def _check(model: Model, case: Case) -> None:
    if isinstance(model, Artifact):
        format = model.description.format
        if case.kind == "training":
            raise ValueError("an exported file cannot be trained")
        if case.mode not in ("eager", format):
            raise ValueError(f"an exported file of the format {format} runs in no other mode")
        if case.precision != "float32":
            raise ValueError("exported files compute in float32")
        return
    if case.kind == "training":
        if next(model.parameters(), None) is None:
            raise ValueError("it has no parameters to train")
        if case.mode not in ("eager", "compiled"):
            raise ValueError("exported files cannot be trained")
    if model.frames and case.mode == "compiled":
        raise ValueError("methods that read sequences are not compiled: set frames=0")


def _smaller(case: Case) -> Case:
    return replace(case, width=min(case.width, SMALL), height=min(case.height, SMALL), batch=1)


def _images(model: Model, names: tuple[str, ...], case: Case) -> dict[str, Tensor]:
    frames = 2 * model.frames + 1 if model.frames else 1
    samples = Sampled(model.samples, case.spp) if model.per_sample else None
    made = example(names, case.batch * frames, case.height, case.width, samples=samples)
    if frames > 1:
        made = {name: image.unflatten(0, (case.batch, frames)) for name, image in made.items()}
    images = {name: image.to(case.device) for name, image in made.items()}
    return images | {"exposure": torch.ones(case.batch, device=case.device)}


def _autocast(case: Case) -> torch.autocast:
    lower = case.precision != "float32"
    dtype = getattr(torch, case.precision) if lower else None
    return torch.autocast(torch.device(case.device).type, dtype, enabled=lower)


class _Inference:
    """What `trainer denoise` does with a frame that is in memory: whole, or in tiles where memory asks.

    Recurrent methods always do the second frame of a sequence: most frames have one before, and the first of
    some methods is less work.
    """

    def __init__(self, model: Model, case: Case) -> None:
        self.model, self.case = model.deploy().eval(), case
        self._call: Any = self.model
        if case.mode == "compiled":
            self._call = torch.compile(self._call, dynamic=False)
        self._state: State | None = None

    def images(self, case: Case) -> dict[str, Tensor]:
        return _images(self.model, self.model.inputs, case)

    def forget(self) -> None:
        self._state = None

    def __call__(self, images: dict[str, Tensor]) -> None:
        if self.model.recurrent and self._state is None:
            self._state = self._denoised(images).state
        self._denoised(images)

    def _denoised(self, images: dict[str, Tensor]) -> Denoised:
        with torch.inference_mode(), _autocast(self.case):
            return denoise_in_tiles(self._call, images, budget=self.case.memory, state=self._state)


class _Training:
    """A step of `trainer.modules.Regression` on what the method's paper compares, with Adam.

    Forward pass, loss, backward pass, update; without Lightning, and the critic of adversarial training.
    """

    def __init__(self, model: Model, case: Case) -> None:
        assert isinstance(model, Denoiser)
        self.net, self.case, self._loss = model.train().requires_grad_(True), case, SMAPE()
        self._optimizer = torch.optim.Adam(self.net.parameters(), lr=RATE)
        kind = torch.device(case.device).type
        self._scaler = torch.amp.GradScaler(kind, enabled=case.precision == "float16")
        self._compare: Callable[[dict[str, Tensor]], Tensor] = self._difference
        if case.mode == "compiled":
            self._compare = torch.compile(self._difference, dynamic=False)

    def images(self, case: Case) -> dict[str, Tensor]:
        return _images(self.net, (*self.net.inputs, *self.net.targets), case)

    def forget(self) -> None:
        self._optimizer.zero_grad(set_to_none=True)
        self._optimizer.state.clear()

    def _difference(self, images: dict[str, Tensor]) -> Tensor:
        pairs = self.net.training_pairs(images).values()
        return torch.stack([self._loss(pair.output, pair.target) for pair in pairs]).sum()

    def __call__(self, images: dict[str, Tensor]) -> None:
        self._optimizer.zero_grad(set_to_none=True)
        with _autocast(self.case):
            loss = self._compare(images)
        self._scaler.scale(loss).backward()
        self._scaler.step(self._optimizer)
        self._scaler.update()
