"""The function that is exported: buffers and frame numbers by name in, `color` out."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from data.buffers import BUFFERS, SAMPLE_BUFFERS, SAMPLES, buffer
from models.denoiser import Denoiser
from trainer.export.description import DEFAULTS


class Entry(nn.Module):
    """Calls a denoiser with tensors by name and returns its color.

    A frame number that is NaN is measured from the images, so that whoever has the whole image may leave it
    out and a tiler may give the number of the whole frame. Frame numbers have one row for all images or one
    row per image.
    """

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.states = tuple(denoiser.state_maps)
        self.names = (*denoiser.inputs, *denoiser.frame_numbers, *self.states)

    def forward(self, buffers: dict[str, Tensor]) -> Tensor | list[Tensor]:
        """Return the color (B, 3, H, W) of buffers (B, C, H, W), samples (B, S, C, H, W) and frame numbers
        (1 or B, …); of recurrent methods, which are given their state too, color and the next state."""
        known = {name: buffers[name] for name in self.names if name not in self.states}
        for name, measured in self.denoiser.measure(known).items():
            if name in known:
                known[name] = torch.where(torch.isnan(known[name]), measured, known[name])
        if not self.states:
            color: Tensor = self.denoiser(known).color
            return color
        made = self.denoiser(known, {name: buffers[name] for name in self.states})
        return [made.color, *(made.state[name] for name in self.states)]


class Positional(nn.Module):
    """The same with the tensors in the order of `Entry.names`, as a graph of an ONNX file needs."""

    def __init__(self, entry: Entry) -> None:
        super().__init__()
        self.entry = entry

    def forward(self, *tensors: Tensor) -> Tensor | list[Tensor]:
        """Return what the entry does."""
        return self.entry(dict(zip(self.entry.names, tensors, strict=True)))


def prepare(denoiser: Denoiser) -> Denoiser:
    """Return a deployed copy in float32 on the CPU, ready to be traced; the original is left alone.

    Raises:
        ValueError: The denoiser cannot be exported, and why.
    """
    if denoiser.no_export:
        raise ValueError(f"{type(denoiser).__name__} cannot be exported: {denoiser.no_export}")
    if denoiser.recurrent and not denoiser.state_maps:
        raise ValueError(
            f"{type(denoiser).__name__} cannot be exported: it does not declare the maps of its state "
            "(`state_maps`), which would be inputs and outputs of the file"
        )
    if denoiser.frames:
        raise ValueError(
            f"{type(denoiser).__name__} reads sequences where `frames` is not 0, which exported files "
            "cannot; export it with frames=0"
        )
    return copy.deepcopy(denoiser).deploy().eval().float().cpu().requires_grad_(False)


def first_state(
    maps: Mapping[str, tuple[int, int]], batch: int, height: int, width: int, multiple: int
) -> dict[str, Tensor]:
    """Return the state that starts sequences of images, zeros (B, C, h, w), on the CPU.

    Args:
        maps: `Denoiser.state_maps`.
        batch: Images.
        height: Rows of the images.
        width: Columns of the images.
        multiple: The method's own grid, to which images are padded.
    """
    tall, wide = (-(-side // multiple) * multiple for side in (height, width))
    return {n: torch.zeros(batch, channels, tall // s, wide // s) for n, (channels, s) in maps.items()}


def default(name: str) -> Tensor:
    """Return the value (1,) or (1, n) of a frame number that nobody gave."""
    value = torch.tensor(DEFAULTS[name], dtype=torch.float32)
    return value if len(DEFAULTS[name]) == 1 else value[None]


class Sampled(NamedTuple):
    """Samples that are kept apart: their quantities in order, and how many there are per pixel."""

    names: tuple[str, ...]
    spp: int


def example(
    inputs: Iterable[str],
    batch: int,
    height: int,
    width: int,
    seed: int = 0,
    samples: Sampled | None = None,
) -> dict[str, Tensor]:
    """Return made-up inputs with the ranges of renders: heavy-tailed radiance with fireflies up to 6e4 and
    black pixels, unit normals, depths with misses; among samples some with NaN or Inf, and pixels whose
    samples all have."""
    generator = torch.Generator().manual_seed(seed)
    size = (batch, height, width)
    made = {}
    for name in inputs:
        if name == SAMPLES and samples is not None:
            made[name] = _samples(samples, size, generator)
        else:
            made[name] = _image(name, size, generator)
    return made


def _samples(samples: Sampled, size: tuple[int, int, int], generator: torch.Generator) -> Tensor:
    batch, height, width = size
    flat = (batch * samples.spp, height, width)
    made = torch.cat([_quantity(name, flat, generator) for name in samples.names], 1)
    made = made.reshape(batch, samples.spp, -1, height, width)
    lost = torch.rand((batch, samples.spp, height, width), generator=generator) < 0.03
    lost |= torch.rand((batch, 1, height, width), generator=generator) < 0.01
    lost[:, :, 1, 2] = True
    made[:, :, 1] = made[:, :, 1].masked_fill(lost, torch.nan)
    made[:, 0, 2, 3, 1] = torch.inf
    return made


def _quantity(name: str, size: tuple[int, int, int], generator: torch.Generator) -> Tensor:
    """Return one quantity of single samples, (B, C, H, W)."""
    plain = name.removeprefix("first_")
    if plain in BUFFERS:
        return _image(plain, size, generator)
    entry = SAMPLE_BUFFERS[name]
    shape = (size[0], len(entry.letters), *size[1:])
    if entry.low is None or entry.high is None:
        return 8 * torch.randn(shape, generator=generator)
    return entry.low + (entry.high - entry.low) * torch.rand(shape, generator=generator)


def _image(name: str, size: tuple[int, int, int], generator: torch.Generator) -> Tensor:
    entry = buffer(name)
    batch, height, width = size
    shape = (batch, entry.channels, height, width)
    uniform = torch.rand(shape, generator=generator)
    pixel = torch.rand((batch, 1, height, width), generator=generator)
    match entry.kind:
        case "radiance":
            noise = torch.exp(1.5 * torch.randn(shape, generator=generator) - 1)
            noise = torch.where(pixel > 0.995, noise * 1000, noise).clamp(max=6e4)
            return torch.where(pixel < 0.1, torch.zeros_like(noise), noise)
        case "vector":
            return nn.functional.normalize(2 * uniform - 1, dim=1)
        case "distance":
            return torch.where(pixel < 0.05, torch.zeros_like(uniform), 2 + 30 * uniform)
        case "count":
            return 1 + torch.floor(8 * uniform)
        case "variance":
            return uniform**4
        case _:
            return uniform


def numbers(denoiser: Denoiser, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return frame numbers unlike the defaults: a widened measured range, others different for each image."""
    batch = next(iter(buffers.values())).shape[0]
    measured = {name: value * 1.25 for name, value in denoiser.measure(buffers).items()}
    given = {}
    for name in denoiser.frame_numbers:
        spread = torch.linspace(0.3, 2.5, batch * len(DEFAULTS[name]))
        given[name] = measured.get(name, spread if len(DEFAULTS[name]) == 1 else spread.reshape(batch, -1))
    return given


@contextmanager
def tracing() -> Iterator[list[str]]:
    """Collect what the tracer doubts, and drop the deprecation of TorchScript and its ONNX exporter.

    The yielded list receives the tracer's warnings: they matter only if parity fails, and say why. Constants
    that the exporter leaves unfolded are not worth a word either; every other warning is passed on.
    """
    doubts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield doubts
    for warning in caught:
        if issubclass(warning.category, torch.jit.TracerWarning):
            doubts.append(f"{warning.filename}:{warning.lineno}: {str(warning.message).split('.')[0]}")
        elif not _known(warning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _known(warning: warnings.WarningMessage) -> bool:
    text = str(warning.message)
    if issubclass(warning.category, DeprecationWarning):
        deprecated = ("torch.jit.", "legacy TorchScript-based ONNX export", "The feature will be removed")
        return any(part in text for part in deprecated)
    # The runtime folds such constants when it loads the file.
    return text.startswith("Constant folding - Only steps=1 can be constant folded")
