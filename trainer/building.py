"""Denoisers from the name of their class: which ones there are, and objects from plain values."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from typing import Any

import torch

import models
from models.denoiser import Denoiser

FORMS = (
    "a checkpoint or run folder of `trainer fit`, an MLflow URI (models:/NAME/VERSION, models:/NAME@ALIAS, "
    "runs:/ID/PATH), an exported .onnx or .ts file, a published checkpoint, or the class name of a denoiser "
    "without parameters"
)
"""What `--model` may be, for messages."""


def class_path_of(name: str, asked: str = "--model") -> str:
    """Return the import path of a denoiser that is named by its class.

    Args:
        name: Its class, one of `models.__all__` or a dotted import path.
        asked: What the name was given to, for the message.

    Raises:
        FileNotFoundError: Penumbra has none of that name; the message lists those it has.
    """
    if "." not in name and name not in models.__all__:
        folded = {known.casefold(): known for known in models.__all__}
        near = difflib.get_close_matches(name.casefold(), folded, n=1)
        hint = f"; did you mean {folded[near[0]]}?" if near else ""
        known = ", ".join(models.__all__)
        if asked != "--model":
            raise FileNotFoundError(f"{asked} {name}: no such denoiser{hint} (there are {known})")
        raise FileNotFoundError(
            f"--model {name}: neither a file nor a denoiser{hint} ({known}); expected {FORMS}"
        )
    return name if "." in name else f"models.{name}"


def build(class_path: str, init_args: Mapping[str, Any]) -> Denoiser:
    """Return a new denoiser of a class, whose nested `{class_path, init_args}` are built as well.

    Raises:
        ValueError: The class cannot be imported, or is not a denoiser.
    """
    cls = find_class(class_path)
    if not issubclass(cls, Denoiser):
        raise ValueError(f"{class_path} is not a denoiser (models.Denoiser)")
    arguments = {name: _nested(value) for name, value in init_args.items()}
    try:
        return cls(**arguments)
    except TypeError as error:
        raise ValueError(f"{class_path} does not take these arguments: {error}") from error


def _nested(value: Any) -> Any:
    if isinstance(value, Mapping) and "class_path" in value:
        arguments = {name: _nested(item) for name, item in (value.get("init_args") or {}).items()}
        return find_class(str(value["class_path"]))(**arguments)
    return value


def find_class(class_path: str) -> type:
    """Return the class of a network, or of a part of one, from its import path.

    Raises:
        ValueError: It cannot be imported, or is something else.
    """
    module, _, name = class_path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"unknown class {class_path!r} ({error}); if it belongs to another package, install that package"
        ) from error
    # Only networks and their parts may be named by a file; other callables could do anything.
    if not (isinstance(found, type) and issubclass(found, torch.nn.Module)):
        raise ValueError(f"{class_path} is not a network")
    return found
