"""Configurations that ship with Penumbra: a bare name works from any directory."""

from __future__ import annotations

import difflib
from pathlib import Path

DEFAULTS = "defaults.yaml"
SEARCH = "search"
"""Folder of what `trainer tune` varies; those files are no configurations."""
ABLATIONS = "ablations"
"""Folder of what `trainer ablate` compares; likewise."""


class UsageError(ValueError):
    """The command line or the configuration is wrong (exit code 2)."""


def folder() -> Path:
    """Return the folder of the shipped configurations, in a wheel or in a checkout."""
    here = Path(__file__).resolve().parent
    installed = here / "configs"
    return installed if installed.is_dir() else here.parent / "configs"


def names() -> list[str]:
    """Return the names that `--config` accepts without a path."""
    base = folder()
    return sorted(
        str(p.relative_to(base))
        for p in base.rglob("*.yaml")
        if p.name != DEFAULTS and p.parent.name not in (SEARCH, ABLATIONS)
    )


def resolve(name: str) -> str:
    """Return the path of a configuration: a file if there is one, otherwise the shipped one.

    Raises:
        UsageError: Neither exists; the message has the nearest shipped name.
    """
    if Path(name).is_file():
        return name
    shipped = folder() / (name if name.endswith((".yaml", ".yml")) else f"{name}.yaml")
    if shipped.is_file():
        return str(shipped)
    near = difflib.get_close_matches(name, names(), n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}? " if near else ""
    raise UsageError(f"--config {name}: no such file; {hint}shipped: {', '.join(names())}")


def resolve_arguments(arguments: list[str]) -> list[str]:
    """Return command-line arguments in which every `--config NAME` names a file."""
    resolved, expecting = [], False
    for argument in arguments:
        if expecting:
            argument, expecting = resolve(argument), False
        elif argument in ("--config", "-c"):
            expecting = True
        elif argument.startswith("--config="):
            argument = f"--config={resolve(argument.removeprefix('--config='))}"
        resolved.append(argument)
    return resolved
