"""What a search varies: keys of a configuration and their values, read from a YAML file and checked.

model.net.layers: {choice: [2, 4, 6]}
model.optimizer.init_args.lr: {loguniform: [0.0005, 0.02]}
data.exposure_stops: {uniform: [0, 2]}
data.batch_size: {int: [2, 8]}
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from trainer import configs
from trainer.configs import UsageError

KINDS = ("choice", "uniform", "loguniform", "int")


@dataclass(frozen=True)
class Range:
    """Values of one key.

    Attributes:
        kind: `choice`, `uniform`, `loguniform` or `int`.
        values: All of them for a choice, otherwise the first and the last; both may be drawn.
    """

    kind: str
    values: tuple[Any, ...]

    def domain(self) -> Any:
        """Return what Ray Tune draws from."""
        from ray import tune

        if self.kind == "choice":
            return tune.choice(list(self.values))
        low, high = self.values
        if self.kind == "int":
            return tune.randint(low, high + 1)
        return tune.loguniform(low, high) if self.kind == "loguniform" else tune.uniform(low, high)


def find_space(name: str) -> Path:
    """Return the file of a space: a path, or the name of one that ships with Penumbra.

    Raises:
        UsageError: There is none; names those that ship.
    """
    folder = configs.folder() / configs.SEARCH
    shipped = folder / (name if name.endswith((".yaml", ".yml")) else f"{name}.yaml")
    for path in (Path(name), shipped):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.name for path in folder.glob("*.yaml")))
    raise UsageError(f"--space {name}: no such file; shipped: {names}")


def read_space(path: Path) -> dict[str, Range]:
    """Read what a search varies.

    Raises:
        UsageError: The file is no such description; names the key and what was expected.
    """
    try:
        tree = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise UsageError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict) or not tree:
        raise UsageError(f"{path}: expected lines such as `model.net.layers: {{choice: [2, 4]}}`")
    return {str(key): _range(f"{path}, {key}", entry) for key, entry in tree.items()}


def _range(place: str, entry: Any) -> Range:
    if not isinstance(entry, dict) or len(entry) != 1:
        raise UsageError(f"{place}: expected one of {', '.join(f'{{{kind}: […]}}' for kind in KINDS)}")
    ((kind, values),) = entry.items()
    if kind not in KINDS:
        near = difflib.get_close_matches(str(kind), KINDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise UsageError(f"{place}: unknown kind {kind!r}{hint} ({', '.join(KINDS)})")
    if not isinstance(values, list) or not values:
        raise UsageError(f"{place}: {kind} expects a list of values")
    if kind == "choice":
        return Range(kind, tuple(values))
    numbers = (int,) if kind == "int" else (int, float)
    if len(values) != 2 or any(type(value) not in numbers for value in values) or values[0] >= values[1]:
        what = "integers" if kind == "int" else "numbers"
        raise UsageError(f"{place}: {kind} expects two {what}, the smaller first, got {values}")
    if kind == "loguniform" and values[0] <= 0:
        raise UsageError(f"{place}: loguniform expects positive numbers, got {values}")
    return Range(kind, tuple(values) if kind == "int" else tuple(map(float, values)))


def options(values: dict[str, Any]) -> list[str]:
    """Return the options of `trainer fit` that set values."""
    # In one word: a parser of options takes a lone -1e-05 for another option.
    return [f"--{key}={_text(value)}" for key, value in sorted(values.items())]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def check_space(space: dict[str, Range], arguments: Sequence[str], path: Path) -> None:
    """Check that a configuration takes every value of a space.

    Args:
        space: What is varied.
        arguments: Command line of `trainer fit` that it is varied of.
        path: File of the space, for messages.

    Raises:
        UsageError: It does not have a key, or not with such a value.
    """
    from trainer.cluster.checked import parsed

    resolved = configs.resolve_arguments(list(arguments))
    rows = max(len(entry.values) for entry in space.values())
    try:
        for row in range(rows):  # a few at once, since each takes half a second
            values = {key: entry.values[row % len(entry.values)] for key, entry in space.items()}
            parsed([*resolved, *options(values)])
    except UsageError:
        for key, entry in space.items():
            for value in entry.values:
                try:
                    parsed([*resolved, *options({key: value})])
                except UsageError as error:
                    raise UsageError(f"{path}, {key}: {value}: {error}") from None
        raise
