"""Exported artifacts as denoisers: what the contract declares, around ONNX Runtime or TorchScript.

Exported files are programs. An ONNX graph computes and does nothing else, but may take any time and memory;
files beside it are not read. A TorchScript archive holds code that runs when it is loaded and when it is
called, in PyTorch's own language: code that names functions which open files is refused, yet it should come
from somebody who is trusted, as a program should. Checkpoints hold no code (`trainer.loading`). Neither
library is hardened against files made to crash it; `trainer serve` loads the model it is started with only.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from data.buffers import SAMPLES, buffer, sample_channels
from models.denoiser import Denoised, State
from models.ops.per_sample import check_samples, sample_depths
from trainer.archives import member_sizes
from trainer.export.description import KEY, Description
from trainer.export.entry import first_state, tracing
from trainer.export.torchscript import EXTRA_FILE

SUFFIXES = {"onnx": ".onnx", "torchscript": ".ts"}
"""File suffix of each format."""

_FILES = re.compile(
    rb"(?<!\w)(from_file|save|load|torch\s*\.\s*classes)(?!\w)"
    rb"|(?<![\w.])ops(?!\s*\.\s*prim\b)(?!\w)"
    rb'|(?<!\w)getattr(?!\s*\(\s*[\w.]+\s*,\s*"\d+"\s*\))(?!\w)'
)
"""Names in TorchScript code, however they are reached, that open files, or lead to operators and classes of
other libraries. Exported denoisers have none: `getattr` only with the number of a part of a list, and `ops`
only within the name of a class."""

_UNPACKED = 20
_DAMAGED = (zipfile.BadZipFile, NotImplementedError, EOFError, RuntimeError, ValueError, OverflowError,
            UnicodeError, struct.error, zlib.error)  # fmt: skip


class Runtime(Protocol):
    """Runs one artifact."""

    def __call__(self, feed: dict[str, Tensor]) -> list[Tensor]:
        """Return the color (B, 3, H, W), and the maps of the next state of a recurrent method."""


class Artifact:
    """An exported denoiser that keeps the contract of `models.denoiser.Denoiser` for inference.

    Attributes:
        description: The metadata of the file.
        inputs, frame_numbers, halo, multiple, temporal, per_sample, samples, fill: As declared by the
            denoiser.
        bytes_per_pixel, bytes_once: Working memory, for tiling.
        recurrent, state_maps: Whether it carries a state, and what that is.
        frames, frame_halo: 0: exported files take images.
    """

    frames = 0
    frame_halo = 0

    def __init__(self, description: Description, runtime: Runtime, name: str) -> None:
        self.description = description
        self.name = name
        self.inputs = description.inputs
        self.frame_numbers = description.frame_numbers
        self.halo = description.halo
        self.multiple = description.multiple
        self.temporal = description.temporal
        self.per_sample = description.per_sample
        self.samples = description.samples
        self.fill = description.fill
        self.state_maps = description.state
        self.recurrent = bool(description.state)
        self.bytes_per_pixel = description.bytes_per_pixel
        self.bytes_once = description.bytes_once
        self._runtime = runtime

    def __call__(self, buffers: Mapping[str, Tensor], state: State | None = None) -> Denoised:
        """Denoise a batch, as `Denoiser.forward` does.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        batch, height, width = self.check(buffers)
        known = (*self.inputs, *self.frame_numbers)
        feed = {name: buffers[name] for name in known if name in buffers}
        if not self.recurrent:
            return Denoised(self._runtime(feed)[0])
        if state is None:
            state = first_state(self.state_maps, batch, height, width, self.multiple)
        color, *maps = self._runtime({**feed, **{name: state[name] for name in self.state_maps}})
        return Denoised(color, dict(zip(self.state_maps, maps, strict=True)))

    def instead(self, available: Collection[str]) -> None:
        """Return nothing: an exported file has one form only."""

    def measure(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the frame numbers that need the whole frame, as the vocabulary defines them."""
        if "depth_range" not in self.frame_numbers:
            return {}
        if "depth" in self.samples and SAMPLES in buffers:
            return {"depth_range": sample_depths(buffers[SAMPLES], self.samples)}
        if "depth" not in buffers:
            return {}
        depth = buffers["depth"].flatten(1)
        return {"depth_range": torch.stack((depth.amin(1), depth.amax(1)), 1)}

    def deploy(self) -> Artifact:
        """Return the artifact itself: it is the deployed form."""
        return self

    def eval(self) -> Artifact:
        """Return the artifact itself: it has no training form."""
        return self

    def check(self, buffers: Mapping[str, Tensor]) -> tuple[int, int, int]:
        """Check names and shapes of the inputs and return (B, H, W).

        Raises:
            ValueError: Names the buffer, what was expected and what came.
        """
        missing = [name for name in self.inputs if name not in buffers]
        if missing:
            raise ValueError(
                f"{self.name} needs the buffers {', '.join(self.inputs)}; missing: {', '.join(missing)}; "
                f"given: {', '.join(buffers) or 'none'}"
            )
        first = buffers[self.inputs[0]].shape
        batch, height, width = first[0], first[-2], first[-1]
        for name in self.inputs:
            if name == SAMPLES:
                inner: tuple[int, ...] = check_samples(
                    buffers[name], sample_channels(*self.samples), self.name
                )
            else:
                inner = (buffer(name).channels,)
            expected = (batch, *inner, height, width)
            if tuple(buffers[name].shape) != expected:
                found = tuple(buffers[name].shape)
                raise ValueError(f"{self.name}: buffer {name!r} has shape {found}, expected {expected}")
        return batch, height, width


class _OnnxRuntime:
    def __init__(self, source: bytes, device: str) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # it warns about every input that has a default
        options.intra_op_num_threads = torch.get_num_threads()
        wanted = ["CUDAExecutionProvider"] if device.startswith("cuda") else []
        missing = [name for name in wanted if name not in onnxruntime.get_available_providers()]
        if missing:
            raise ValueError(
                f"this onnxruntime has no {missing[0]}; install onnxruntime-gpu or use --device cpu"
            )
        self.session = onnxruntime.InferenceSession(source, options, [*wanted, "CPUExecutionProvider"])

    def __call__(self, feed: dict[str, Tensor]) -> list[Tensor]:
        arrays = {name: np.ascontiguousarray(v.detach().float().cpu().numpy()) for name, v in feed.items()}
        try:
            return [torch.from_numpy(made) for made in self.session.run(None, arrays)]
        except _runtime_errors() as error:
            first = str(error).splitlines()[0][:200]
            raise OSError(
                f"ONNX Runtime cannot run the model ({first}); lower --memory, or export the model again"
            ) from error


class _TorchScript:
    def __init__(self, module: Any, device: str) -> None:
        self.module = module
        self.device = device

    def __call__(self, feed: dict[str, Tensor]) -> list[Tensor]:
        with torch.inference_mode():
            made = self.module({name: value.to(self.device) for name, value in feed.items()})
        return [made] if isinstance(made, Tensor) else list(made)


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Return the errors of ONNX Runtime, which have no class in common."""
    from onnxruntime.capi import onnxruntime_pybind11_state as states

    found = vars(states).values()
    return tuple(kind for kind in found if isinstance(kind, type) and issubclass(kind, Exception))


def load_artifact(path: Path | str, device: str = "cpu") -> Artifact:
    """Load an exported file; its content, not its suffix, says which format it has.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, of another kind, or was not exported by Penumbra.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if is_archive(path):
        return open_torchscript(path.read_bytes(), str(path), device)
    return open_onnx(path.read_bytes(), str(path), device)


def is_archive(path: Path) -> bool:
    """Return whether a file is a ZIP archive, whatever state it is in."""
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # its end is damaged
        return True


def open_onnx(content: bytes, name: str, device: str = "cpu") -> Artifact:
    """Open the content of an ONNX file; `name` is for messages. Raises as `load_artifact` does."""
    description = _described(_onnx_metadata(content, name), name)
    try:
        runtime = _OnnxRuntime(content, device)
    except _runtime_errors() as error:
        first = str(error).splitlines()[0][:200]
        raise ValueError(
            f"{name} is not an ONNX or TorchScript file, or is damaged ({first}); export the model again"
        ) from error
    return Artifact(description, runtime, name)


def _onnx_metadata(content: bytes, name: str) -> str | None:
    """Return the description in an ONNX file; refuses weights in other files and foreign operators."""
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.load_model_from_string(content)
    except (DecodeError, ValueError) as error:
        raise ValueError(
            f"{name} is not an ONNX or TorchScript file, or is damaged ({error}); export the model again"
        ) from error
    for message in _messages(model):
        if isinstance(message, onnx.TensorProto) and (message.data_location or message.external_data):
            raise ValueError(f"{name} has weights in other files, which are not read; export the model again")
        if isinstance(message, onnx.NodeProto) and message.domain not in ("", "ai.onnx"):
            raise ValueError(
                f"{name} has operators of {message.domain[:80]!r}, which Penumbra does not export"
            )
    return next((entry.value for entry in model.metadata_props if entry.key == KEY), None)


def _messages(message: Any) -> Iterator[Any]:
    """Yield a message of a protocol buffer and all that are in it."""
    waiting = [message]
    while waiting:
        yield (message := waiting.pop())
        for field, value in message.ListFields():
            if field.message_type is not None:
                waiting += [value] if hasattr(value, "ListFields") else list(value)


def open_torchscript(content: bytes, name: str, device: str = "cpu") -> Artifact:
    """Open the content of a TorchScript archive; `name` is for messages. Raises as `load_artifact` does."""
    extra = {EXTRA_FILE: ""}
    _check_code(content, name)
    try:
        with tracing():
            module = torch.jit.load(io.BytesIO(content), map_location=device, _extra_files=extra)
    except (RuntimeError, IndexError) as error:
        first = str(error).splitlines()[0][:200]
        raise ValueError(f"{name} is not a TorchScript archive, or is damaged ({first})") from error
    text = extra[EXTRA_FILE]
    text = text.decode() if isinstance(text, bytes) else text
    return Artifact(_described(text, name), _TorchScript(module.eval(), device), name)


def _check_code(content: bytes, name: str) -> None:
    """Refuse an archive whose members claim more than it has, or whose code opens files.

    Raises:
        ValueError: It does, or is damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in member_sizes(archive, len(content), _UNPACKED):
                data = archive.read(member)  # compares its checksum, which PyTorch does not
                if member.endswith(".py") and (found := _FILES.search(data)):
                    raise ValueError(f"its code uses {found[0].decode()}, which Penumbra does not export")
    except _DAMAGED as error:
        raise ValueError(f"{name} is not a TorchScript archive, or is damaged ({error})") from error


def _described(text: str | None, name: str) -> Description:
    if not text:
        raise ValueError(
            f"{name} was not exported by Penumbra: its metadata has no {KEY!r}. Make it with `trainer export`"
        )
    try:
        return Description.from_json(text)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
