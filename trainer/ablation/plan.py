"""The file that describes an ablation: variants of configurations, and where each stands in tables and plots.

title: Branches in training
config: wskp_bmfr.yaml                  # of variants that name none; a list is laid over each other
options: {trainer.max_steps: 600}       # of all variants
metrics: [psnr_wskp, ssim_wskp]         # of tables; the first is drawn
layouts:
  table5: {kind: pairs, title: As table 5}
  figure10: {kind: curve, title: As figure 10, axis: kernels}
variants:
  - name: WSKP, without branches
    config: wskp_bmfr.yaml
    options: {model.net.branches: false}
    places: {table5: [WSKP, w/o], figure10: 6}

A place in `pairs` is a row and a column, in a `curve` a number on its axis.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from trainer import configs
from trainer.configs import UsageError
from trainer.evaluation.plan import INPUT, PLACES, REFERENCE
from trainer.metrics.measures import SCORES

METRICS = ("psnr_wskp", "ssim_wskp")
PAIRS, CURVE = "pairs", "curve"
RESERVED = (INPUT, REFERENCE, PLACES)
"""Names of columns and folders of every evaluation."""
OVERVIEW = "variants"
"""Name of the table that every ablation has."""
_NAME = re.compile(r"[^\s=:/\\|][^=:/\\|\n]{0,59}")

Place = tuple[str, str] | float


@dataclass(frozen=True)
class Layout:
    """A table, or a table and a plot, that variants have places in.

    Attributes:
        name: Of its files.
        kind: `pairs`: a column for each metric and column, a row for each scene and row. `curve`: metrics and
            time over a number.
        title: What it shows.
        axis: What the number of a curve is.
    """

    name: str
    kind: str
    title: str
    axis: str = ""


@dataclass(frozen=True)
class Variant:
    """One training.

    Attributes:
        name: In tables.
        configs: Configurations that are laid over each other.
        options: Key of the configuration → value.
        places: Name of a layout → row and column, or number.
        common: Options of all variants; those of the command line count more.
    """

    name: str
    configs: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    places: Mapping[str, Place] = field(default_factory=dict)
    common: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Ablation:
    """What is compared.

    Attributes:
        name: Of the file, and of the experiment in MLflow.
        title: What it shows.
        variants: What is trained, in order.
        layouts: Name → table or plot.
        metrics: Of tables; the first is drawn.
    """

    name: str
    title: str
    variants: tuple[Variant, ...]
    layouts: Mapping[str, Layout] = field(default_factory=dict)
    metrics: tuple[str, ...] = METRICS

    def placed(self, layout: str) -> list[tuple[Variant, Any]]:
        """Return the variants of a layout with their places, in order; those of a curve by their numbers."""
        found = [(variant, variant.places[layout]) for variant in self.variants if layout in variant.places]
        return sorted(found, key=lambda pair: pair[1]) if self.layouts[layout].kind == CURVE else found


def find_ablation(name: str) -> Path:
    """Return the file of an ablation: a path, or the name of one that ships with Penumbra.

    Raises:
        UsageError: There is none; names those that ship.
    """
    file = name if name.endswith((".yaml", ".yml")) else f"{name}.yaml"
    folder = configs.folder()
    for path in (Path(name), folder / file, folder / configs.ABLATIONS / file):
        if path.is_file():
            return path
    shipped = ", ".join(
        f"{configs.ABLATIONS}/{p.name}" for p in sorted((folder / "ablations").glob("*.yaml"))
    )
    raise UsageError(f"--config {name}: no such file; ablations that ship: {shipped}")


def read_ablation(path: Path) -> Ablation:
    """Read what is compared.

    Raises:
        UsageError: The file is no such description; names the entry and what was expected.
    """
    try:
        tree = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise UsageError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict) or not isinstance(tree.get("variants"), list) or not tree["variants"]:
        raise UsageError(
            f"{path} describes no ablation: expected a list of `variants`; see trainer ablate -h"
        )
    _only(str(path), tree, ("title", "config", "options", "metrics", "layouts", "variants"))
    layouts = _layouts(path, tree.get("layouts") or {})
    common = _options(str(path), tree)
    variants = tuple(_variant(path, tree.get("config"), common, entry, layouts) for entry in tree["variants"])
    names = [variant.name for variant in variants]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"{path}: two variants are called {twice[0]!r}")
    for name, layout in layouts.items():
        _check_places(path, layout, [(v.name, v.places[name]) for v in variants if name in v.places])
    return Ablation(
        path.stem, str(tree.get("title") or path.stem), variants, layouts, _metrics(path, tree.get("metrics"))
    )


def _only(place: str, entry: Any, known: tuple[str, ...]) -> None:
    """Raise a UsageError unless an entry is a mapping with known keys."""
    if not isinstance(entry, dict):
        raise UsageError(f"{place}: expected a mapping with {', '.join(known)}, got {entry!r}")
    if wrong := [key for key in entry if key not in known]:
        raise UsageError(f"{place}: unknown {wrong[0]!r}; expected {', '.join(known)}")


def _layouts(path: Path, tree: Any) -> dict[str, Layout]:
    if not isinstance(tree, dict):
        raise UsageError(f"{path}, layouts: expected names, each with {{kind: {PAIRS} or {CURVE}, title: …}}")
    found = {}
    for name, entry in tree.items():
        place = f"{path}, layouts, {name}"
        _only(place, entry, ("kind", "title", "axis"))
        if not re.fullmatch(r"\w+", str(name), re.ASCII):
            raise UsageError(f"{place}: names of layouts have letters, digits and _ only, as files have them")
        if str(name).lower() == OVERVIEW:
            raise UsageError(f"{place}: {OVERVIEW} is the table of all variants; choose another name")
        if entry.get("kind") not in (PAIRS, CURVE):
            raise UsageError(f"{place}: kind {entry.get('kind')!r}; expected {PAIRS} or {CURVE}")
        title = str(entry.get("title") or name)
        found[str(name)] = Layout(str(name), entry["kind"], title, str(entry.get("axis") or name))
    return found


def _check_places(path: Path, layout: Layout, taken: list[tuple[str, Place]]) -> None:
    """Raise a UsageError where two variants stand in one place of a table of pairs."""
    seen: dict[Place, str] = {}
    for name, place in taken if layout.kind == PAIRS else []:
        if (other := seen.setdefault(place, name)) != name:
            raise UsageError(
                f"{path}, variant {name}, places, {layout.name}: {other!r} has the place {place} already"
            )


def _options(place: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    options = entry.get("options") or {}
    if not isinstance(options, dict):
        raise UsageError(f"{place}, options: expected lines such as `model.net.branches: false`")
    return {str(key): value for key, value in options.items()}


def _variant(
    path: Path, config: Any, common: Mapping[str, Any], entry: Any, layouts: Mapping[str, Layout]
) -> Variant:
    name = entry.get("name") if isinstance(entry, dict) else None
    place = f"{path}, variant {name}"
    _only(place, entry, ("name", "config", "options", "places"))
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name != name.strip() or name in RESERVED:
        raise UsageError(
            f"{place}: expected a name of up to 60 letters without = : / \\ | and spaces at its ends, and "
            f"none of {', '.join(RESERVED)}"
        )
    files = entry.get("config", config)
    files = [files] if isinstance(files, str) else files
    if not isinstance(files, list) or not files or not all(isinstance(file, str) for file in files):
        raise UsageError(f"{place}: expected `config: FILE.yaml`, here or for all variants")
    options = _options(place, entry)
    places = entry.get("places") or {}
    _only(f"{place}, places", places, tuple(layouts))
    taken = {key: _place(f"{place}, places, {key}", layouts[key], value) for key, value in places.items()}
    return Variant(name, tuple(files), options, taken, common)


def _place(place: str, layout: Layout, value: Any) -> Place:
    if layout.kind == PAIRS:
        if not isinstance(value, list) or len(value) != 2:
            raise UsageError(f"{place}: expected [row, column], got {value!r}")
        return str(value[0]), str(value[1])
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"{place}: expected a number, got {value!r}")
    return float(value)


def _metrics(path: Path, named: Any) -> tuple[str, ...]:
    if named is None:
        return METRICS
    if not isinstance(named, list) or not named or any(str(name) not in SCORES for name in named):
        raise UsageError(f"{path}, metrics: {named!r}; expected a list of some of {', '.join(SCORES)}")
    return tuple(dict.fromkeys(named))
