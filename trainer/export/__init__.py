"""Exported artifacts: ONNX and TorchScript files that take what a renderer wrote."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from models.denoiser import Denoiser
from trainer.export import onnx, torchscript
from trainer.export.artifact import SUFFIXES, Artifact, load_artifact, open_onnx, open_torchscript
from trainer.export.description import Description, Parity, Source, describe
from trainer.export.entry import prepare
from trainer.export.parity import LIMIT, measure_parity
from trainer.outputs import refuse_existing, replacing

__all__ = ["SUFFIXES", "Artifact", "Parity", "Source", "export", "load_artifact"]

Format = Literal["onnx", "torchscript"]


def export(
    denoiser: Denoiser,
    path: Path | str,
    format: Format = "onnx",
    *,
    source: Source | None = None,
    force: bool = False,
    limit: float = LIMIT,
) -> Parity:
    """Write a denoiser as an ONNX or TorchScript file that agrees with it.

    The file takes the denoiser's inputs by name, (B, C, H, W) float32 with any batch and size, and optionally
    its frame numbers; it returns `color` (B, 3, H, W), which an ONNX file calls `denoised` where `color` is
    an input. Its metadata (`trainer.export.description.Description`) hold the contract's declarations, the
    source, the versions and the measured parity.

    Args:
        denoiser: What to export; it is copied and left as it is.
        path: The file to write; by custom with the suffix of `SUFFIXES`.
        format: `onnx` or `torchscript`.
        source: Where the weights came from, for the metadata.
        force: Replace a file that is already there.
        limit: Largest relative error against eager.

    Returns:
        The measured parity.

    Raises:
        ValueError: The format is unknown, the file exists, the model cannot be exported, or the result
            differs from eager by more than `limit`. Nothing is written then.
        OSError: The file cannot be written.
    """
    path = Path(path)
    if format not in SUFFIXES:
        raise ValueError(f"unknown format {format!r}; known: {', '.join(SUFFIXES)}")
    refuse_existing([path], force)
    ready = prepare(denoiser)
    content, parity = _build(ready, describe(denoiser, format, source), format, limit)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return parity


def _build(ready: Denoiser, description: Description, format: Format, limit: float) -> tuple[bytes, Parity]:
    if format == "onnx":
        content, doubts = onnx.build(ready)
        trial = open_onnx(onnx.describe_file(content, description), "the exported file")
    else:
        module, doubts = torchscript.build(ready)
        trial = open_torchscript(torchscript.serialise(module, description), "the exported file")
    runtime = "onnxruntime" if format == "onnx" else "torch"
    try:
        parity = measure_parity(trial, ready, f"{runtime} {description.versions[runtime]}", limit)
    except ValueError as error:
        hint = f" (while tracing, {doubts[0]})" if doubts else ""
        raise ValueError(f"{description.model} cannot be exported as {format}: {error}{hint}") from error
    described = replace(description, parity=parity)
    if format == "onnx":
        return onnx.describe_file(content, described), parity
    return torchscript.serialise(module, described), parity
