"""What is compared on what: methods with their names, frames, and the folder that holds all of it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from trainer.clips import Clip, find_clips

INPUT, REFERENCE, PLACES = "input", "reference", "places"
"""Folders below `images` beside those of the methods: the noisy frames, what they should be, and where each
pixel was in the frame before."""

_RESERVED = {INPUT, REFERENCE, PLACES}

NOISY = "trainer.evaluation.noisy.Noisy"


@dataclass(frozen=True)
class Method:
    """One column of the tables.

    Attributes:
        label: Its name there.
        model: What `--model` named.
        options: `KEY=VALUE` of a method that is named by its class.
        folder: Name of its folder below `images`.
    """

    label: str
    model: str
    options: tuple[str, ...] = ()
    folder: str = ""


@dataclass(frozen=True)
class Setting:
    """How everything is run.

    Attributes:
        root: The data set, as the user named it.
        split: Which part.
        data: What tells these frames from others: the hash of a manifest, or names.
        names: Frames in order, and for each that of the preceding one of its sequence.
        folder: Of the evaluation.
        metrics: Names of the metrics.
        device: Where methods run.
        memory: Bytes that a call of a method may take.
        jobs: Processes that take scores.
        exposures: Exposure at which a frame is judged, for all methods: that of the input. It is known when
            the input was read.
    """

    root: str
    split: str | None
    data: str
    names: dict[str, str | None]
    folder: Path
    metrics: tuple[str, ...]
    device: str = "cpu"
    memory: int = 2 * 1024**3
    jobs: int = 1
    exposures: dict[str, float] = field(default_factory=dict)


def methods_of(named: Sequence[tuple[str, Sequence[str]]]) -> list[Method]:
    """Return the methods that models with their options mean, with different names.

    Args:
        named: `MODEL` or `LABEL=MODEL`, and its options.

    Raises:
        ValueError: A label was given twice, or is that of the input or the reference.
    """
    found: list[Method] = []
    for text, options in named:
        label, model = _split(text)
        given = label is not None
        label = label or " ".join([_short(model), *options])
        taken = {method.label for method in found} | {INPUT, REFERENCE, PLACES}
        if given and label in taken:
            raise ValueError(f"--model {text}: {label} is the name of another column; choose another")
        name, number = label, 1
        while name in taken:
            number += 1
            name = f"{label} ({number})"
        found.append(Method(name, model, tuple(options)))
    return _with_folders(found)


def _split(text: str) -> tuple[str | None, str]:
    """Return the label and the model of `LABEL=MODEL`."""
    label, sign, model = text.partition("=")
    named = sign and label.strip() and model and not any(mark in label for mark in ":/\\")
    if not named or Path(text).exists():
        return None, text
    return label.strip(), model


def _short(model: str) -> str:
    """Return how a model is called in tables: its name without folders, `wskp/3` of `models:/wskp/3`."""
    if found := re.match(r"(?:models|runs):/+(.+)", model):
        return found[1]
    path = Path(model)
    parts = [part for part in path.parts if part not in ("checkpoints", "/")]
    if path.suffix == ".ckpt" and len(parts) > 1:
        return parts[-2] if path.stem in ("best", "last") else f"{parts[-2]} {path.stem}"
    return path.stem if path.suffix in (".onnx", ".ts", ".pt", ".pth") else path.name or model


def _with_folders(methods: Iterable[Method]) -> list[Method]:
    return [replace(method, folder=folder_of(method.label)) for method in methods]


def folder_of(label: str) -> str:
    """Return the name of a method's folder, which follows from its label alone.

    That is the label where it makes a good name, and otherwise what does of it, with a hash.
    """
    if re.fullmatch(r"\w[A-Za-z0-9._-]{0,59}", label, re.ASCII) and label.lower() not in _RESERVED:
        return label
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", label).strip("-.")[:48] or "method"
    return f"{name}-{hashlib.sha256(label.encode()).hexdigest()[:8]}"


def clips_of(root: str, split: str) -> tuple[list[Clip], str | None]:
    """Return the frames of a data set and the split that they are, None for all there are.

    Args:
        root: As a path of `trainer denoise`.
        split: `train`, `validation`, `test`, `all`, or `auto`: the test split of a data set that has one.

    Raises:
        ValueError: As `trainer.clips.find_clips`.
        FileNotFoundError: There is no such path.
    """
    if split not in ("auto", "all"):
        return find_clips([root], split), split
    if split == "auto":
        try:
            return find_clips([root], "test"), "test"
        except ValueError:
            pass  # no splits, or no test scene
    return find_clips([root], None), None
