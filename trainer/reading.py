"""Checkpoints as plain values and tensors, read without running code from them."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from trainer.archives import ForeignObject, check_archive
from trainer.building import FORMS
from trainer.export.artifact import is_archive

_DAMAGED = (RuntimeError, OSError, EOFError, LookupError, AttributeError, TypeError, ValueError,
            ArithmeticError, AssertionError)  # fmt: skip
_VALUES, _DEPTH, _INTEGER = 10_000, 32, 1 << 20


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the dictionary in a file of `torch.save`, read without running code from it.

    Plain values and tensors are read, nothing else; memory is taken for what the file holds, not for what it
    claims (`trainer.archives`).

    Raises:
        ValueError: The file is truncated, not a checkpoint, or holds objects that only pickle could restore.
    """
    if not is_archive(path):
        if _may_be_cut(path):
            raise ValueError(f"{path} is truncated or not a checkpoint (its archive has no end)")
        reason = "its content is neither a checkpoint nor an exported model"
        raise ValueError(f"{path} cannot be loaded: {reason}; expected {FORMS}")
    try:
        check_archive(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (ForeignObject, pickle.UnpicklingError) as error:
        reason = "it holds Python objects beside tensors and plain values, which are not loaded for safety"
        first = (str(error).splitlines() or [""])[0][:100]
        raise ValueError(f"{path} cannot be loaded: {reason} ({first}); expected {FORMS}") from error
    except PermissionError:
        raise
    except _DAMAGED as error:
        first = (str(error).splitlines() or [repr(error)])[0][:160]
        raise ValueError(f"{path} is truncated or not a checkpoint ({first})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}, expected a checkpoint's dictionary")
    return content


def _may_be_cut(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04"


def network_of(checkpoint: Mapping[str, Any], path: Path) -> tuple[str, dict[str, Any]]:
    """Return class path and arguments of the network that a checkpoint of `trainer fit` holds.

    Raises:
        ValueError: It does not say, or with values that no configuration has.
    """
    parameters = checkpoint.get("hyper_parameters")
    tree = parameters.get("net") if isinstance(parameters, Mapping) else None
    tree = plain(tree, path)
    arguments = (tree.get("init_args") or {}) if isinstance(tree, dict) else None
    if not isinstance(tree, dict) or "class_path" not in tree or not isinstance(arguments, dict):
        raise ValueError(f"{path} does not say which network it holds (hyper_parameters.net.class_path)")
    return str(tree["class_path"]), arguments


def plain(values: Any, path: Path) -> Any:
    """Return a copy of what a configuration may hold: text, numbers, lists and dictionaries.

    Raises:
        ValueError: It holds something else, or more than any configuration does.
    """
    left = _VALUES

    def copied(value: Any, depth: int) -> Any:
        nonlocal left
        left -= 1
        if left < 0 or depth > _DEPTH:
            raise ValueError(f"{path} has hyper-parameters of too many values; it is damaged")
        if isinstance(value, dict) and all(isinstance(key, str) for key in value):
            return {key: copied(item, depth + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return type(value)([copied(item, depth + 1) for item in value])
        if (
            value is None
            or isinstance(value, bool | float | str)
            or (isinstance(value, int) and abs(value) < _INTEGER)
        ):
            return value
        raise ValueError(f"{path} has hyper-parameters that are no text or number: {type(value).__name__}")

    return copied(values, 0)
