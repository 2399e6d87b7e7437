"""Export to ONNX.

The graph's inputs carry the buffers' names, the output is `color` (`denoised` where `color` is an input);
batch, samples per pixel, height and width are free. Frame numbers are inputs with a default value: an
initializer of the same name, which ONNX lets the caller override. ONNX Runtime lists them under
`get_overridable_initializers()`.

PyTorch has two exporters. On a convolution, box-filter and softmax network like WSKP (torch 2.13, two CPU
cores) the one that traces took 0.2 s and gave a file that runs with every batch and size; the one built on
`torch.export` took 6.6 s and fixes the length of the frame numbers to that of the batch, so they cannot have
a default. The first is therefore used, although PyTorch calls it legacy.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import onnx
import torch

from data.buffers import SAMPLES, sample_channels
from models.denoiser import Denoiser
from trainer.export.description import KEY, Description, output_name
from trainer.export.entry import Entry, Positional, Sampled, default, example, first_state, tracing

OPSET = 17
"""ONNX operator set: the oldest one with every operator in use, which ONNX Runtime has since 1.12."""


def following(name: str) -> str:
    """Return the name of the output that is a map of the next frame's state."""
    return f"next_{name}"


def build(denoiser: Denoiser) -> tuple[bytes, list[str]]:
    """Return the ONNX file of a prepared denoiser, and what the tracer doubted."""
    buffers = example(denoiser.inputs, 2, 48, 32, samples=Sampled(denoiser.samples, 3))
    given = {name: default(name) for name in denoiser.frame_numbers}
    output = output_name(tuple(denoiser.inputs))
    free = {0: "batch", 2: "height", 3: "width"}
    axes = dict.fromkeys((*buffers, output), free) | {name: {0: "frames"} for name in given}
    if SAMPLES in buffers:
        axes[SAMPLES] = {0: "batch", 1: "samples", 3: "height", 4: "width"}
    states = first_state(denoiser.state_maps, 2, 48, 32, denoiser.multiple)
    for name in states:
        axes |= {n: {0: "batch", 2: f"{name}_height", 3: f"{name}_width"} for n in (name, following(name))}
    entry = Entry(denoiser).eval()
    # Two rows: the tracer would otherwise see a batch of one and leave out broadcasts.
    tensors = tuple(buffers.values()) + tuple(value.repeat_interleave(2, 0) for value in given.values())
    tensors += tuple(states.values())
    with tracing() as doubts, torch.inference_mode(), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        torch.onnx.export(
            Positional(entry), tensors, path, dynamo=False, opset_version=OPSET,
            input_names=list(entry.names), output_names=[output, *map(following, states)], dynamic_axes=axes,
        )  # fmt: skip
        model = onnx.load(path)
    for name, value in given.items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value.numpy(), name))
    onnx.checker.check_model(model)
    return model.SerializeToString(), doubts


def describe_file(content: bytes, description: Description) -> bytes:
    """Return the same ONNX file with this description in its metadata."""
    model = onnx.load_model_from_string(content)
    model.producer_name, model.producer_version = "Penumbra", description.versions["penumbra-denoise"]
    model.doc_string = (
        f"{description.model}: linear radiance `{description.output}` (B, 3, H, W) from "
        f"{', '.join(description.inputs)}. "
        f"Optional: {', '.join(description.frame_numbers) or 'nothing'}."
    )
    if description.per_sample:
        channels = ", ".join(sample_channels(*description.samples))
        model.doc_string += (
            f" `{SAMPLES}` (B, S, C, H, W): any number S of samples per pixel, C channels in this order: "
            f"{channels}. Samples with a channel that is NaN or Inf do not count."
        )
    if description.state:
        maps = ", ".join(
            f"`{name}` (B, {channels}, H / {side}, W / {side})"
            for name, (channels, side) in description.state.items()
        )
        model.doc_string += (
            f" State: {maps}, of an image padded to multiples of {description.multiple}. Zeros start a "
            f"sequence; outputs `{following(next(iter(description.state)))}` … go into the next frame."
        )
    del model.metadata_props[:]
    model.metadata_props.add(key=KEY, value=replace(description, format="onnx").to_json())
    return model.SerializeToString()
