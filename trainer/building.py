"""Denoisers from the name of their class: which ones there are, and objects from plain values."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch.nn.modules import module as modules

import models
from models.denoiser import Denoiser

FORMS = (
    "a checkpoint or run folder of `trainer fit`, an MLflow URI (models:/NAME/VERSION, models:/NAME@ALIAS, "
    "runs:/ID/PATH), an exported .onnx or .ts file, a published checkpoint, or the class name of a denoiser "
    "without parameters"
)
"""What `--model` may be, for messages."""

OUTSIDE = {"OIDN": "trainer.oidn.OIDN"}
"""Denoisers that are libraries of their own, to compare with: name → import path."""


def class_path_of(name: str, asked: str = "--model") -> str:
    """Return the import path of a denoiser that is named by its class.

    Args:
        name: Its class, one of `models.__all__` or a dotted import path.
        asked: What the name was given to, for the message.

    Raises:
        FileNotFoundError: Penumbra has none of that name; the message lists those it has.
    """
    if name in OUTSIDE:
        return OUTSIDE[name]
    if "." not in name and name not in models.__all__:
        names = (*models.__all__, *OUTSIDE)
        folded = {known.casefold(): known for known in names}
        near = difflib.get_close_matches(name.casefold(), folded, n=1)
        hint = f"; did you mean {folded[near[0]]}?" if near else ""
        known = ", ".join(names)
        if asked != "--model":
            raise FileNotFoundError(f"{asked} {name}: no such denoiser{hint} (there are {known})")
        raise FileNotFoundError(
            f"--model {name}: neither a file nor a denoiser{hint} ({known}); expected {FORMS}"
        )
    return name if "." in name else f"models.{name}"


TRUSTED = "PENUMBRA_TRUST"
"""Variable with the packages, separated by commas, that files may name classes of beside Penumbra's."""

_LIMIT = 1 << 12


def build(class_path: str, init_args: Mapping[str, Any], foreign: bool = False) -> Denoiser:
    """Return a new denoiser of a class, whose nested `{class_path, init_args}` are built as well.

    Args:
        class_path: Import path of the class.
        init_args: Arguments of its constructor.
        foreign: A file names the class, not the user; see `find_class`.

    Raises:
        ValueError: The class cannot be imported, is not a denoiser, or refuses the arguments.
    """
    cls = find_class(class_path, foreign)
    if not issubclass(cls, Denoiser):
        raise ValueError(f"{class_path} is not a denoiser (models.Denoiser)")
    arguments = {name: _nested(value, foreign) for name, value in init_args.items()}
    try:
        return cls(**arguments)
    except TypeError as error:
        raise ValueError(f"{class_path} does not take these arguments: {error}") from error


def _nested(value: Any, foreign: bool) -> Any:
    if isinstance(value, Mapping) and "class_path" in value:
        given = value.get("init_args") or {}
        if not isinstance(given, Mapping):
            raise ValueError(f"init_args of {value['class_path']} are no mapping")
        arguments = {name: _nested(item, foreign) for name, item in given.items()}
        return find_class(str(value["class_path"]), foreign)(**arguments)
    return value


def find_class(class_path: str, foreign: bool = False) -> type:
    """Return the class of a network, or of a part of one, from its import path.

    Args:
        class_path: The path.
        foreign: A file names it, not the user: nothing is imported for it but Penumbra, the layers of
            PyTorch and packages that the variable `PENUMBRA_TRUST` names, since importing runs code.
            Denoisers of modules that this process has imported are found as well.

    Raises:
        ValueError: It cannot be imported, or is something else.
    """
    module, _, name = class_path.rpartition(".")
    if foreign and not _is_trusted(module):
        held = sys.modules.get(module)
        if held is None:
            raise ValueError(
                f"class {class_path!r} is not one of Penumbra; a file may not choose what is imported; "
                f"if you trust it, install that package and set {TRUSTED}={module.partition('.')[0]}"
            )
        found = vars(held).get(name)
        if not (isinstance(found, type) and issubclass(found, Denoiser)):
            raise ValueError(f"{class_path} is not a network that a file may name")
        return found
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"unknown class {class_path!r} ({error}); if it belongs to another package, install that package"
        ) from error
    # Only networks and their parts may be named; other callables could do anything.
    if not (isinstance(found, type) and issubclass(found, torch.nn.Module)):
        raise ValueError(f"{class_path} is not a network")
    return found


def _is_trusted(module: str) -> bool:
    trusted = [name.strip() for name in os.environ.get(TRUSTED, "").split(",")]
    return any(
        module == name or module.startswith(f"{name}.") for name in ("models", "torch.nn", *trusted) if name
    )


@contextmanager
def outlined(parts: int) -> Iterator[None]:
    """Build networks without memory for their weights, and stop where they have many more parts than stored.

    Args:
        parts: Number of stored weights.

    Raises:
        ValueError: The network has many more.
    """
    left = [_LIMIT + 4 * parts]

    def count(*_: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise ValueError("its arguments ask for a network of far more weights than are stored")

    hooks = [
        modules.register_module_parameter_registration_hook(count),
        modules.register_module_buffer_registration_hook(count),
        modules.register_module_module_registration_hook(count),
    ]
    try:
        with torch.device("meta"):
            yield
    finally:
        for hook in hooks:
            hook.remove()
