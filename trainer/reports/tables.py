"""Tables of metrics on the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from trainer.metrics.collection import METRICS, SOURCES

if TYPE_CHECKING:
    from trainer.evaluation import cells

TITLES = {"test": "Held-out scenes, whole frames", "val": "Validation crops"}


def scores_by_scene(logged: Mapping[str, Any], prefix: str) -> dict[str, dict[str, float]]:
    """Return scene → metric → value from logged names `<prefix>/<metric>[/<scene>]`, the average last."""
    table: dict[str, dict[str, float]] = {}
    for key, value in logged.items():
        parts = key.split("/", 2)
        if parts[0] == prefix and len(parts) > 1 and parts[1] in METRICS:
            table.setdefault(parts[2] if len(parts) == 3 else "average", {})[parts[1]] = float(value)
    average = table.pop("average", None)
    return {**dict(sorted(table.items())), **({"average": average} if average else {})}


def scores_table(logged: Mapping[str, Any], prefix: str, source: str = "wskp") -> Table:
    """Return a table with one row per scene and method: the noisy input and the denoised frames.

    Args:
        logged: What was logged.
        prefix: `test` or `val`.
        source: Whose metrics, a key of `SOURCES`.
    """
    metrics = {name: metric for name, metric in METRICS.items() if metric.source == source}
    title = TITLES.get(prefix, prefix)
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("scene", no_wrap=True)
    table.add_column("image", no_wrap=True)
    for name, metric in metrics.items():
        # "ssim_wskp_range1" is the widest name; two lines keep the table within 90 columns.
        heading = name.replace("_range1", "\n_range1") if "_range1" in name else f"{name}\n"
        table.add_column(f"{heading} {'↑' if metric.higher else '↓'}", justify="right", no_wrap=True)
    denoised = scores_by_scene(logged, prefix)
    noisy = scores_by_scene(logged, "input") if prefix == "test" else {}
    for scene, row in denoised.items():
        for label, values in (("input", noisy.get(scene)), ("denoised", row)):
            if values is not None:
                cells = [metric.format.format(values[name]) for name, metric in metrics.items()]
                table.add_row(scene, label, *cells, style="bold" if label == "denoised" else "dim")
        table.add_section()
    return table


def print_scores(logged: Mapping[str, Any], prefix: str) -> None:
    """Print the metrics per scene and averaged: one table for each group, with its definitions."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=100)  # a pipe has no width; narrower columns would be cut
    for source, definition in SOURCES.items():
        console.print(scores_table(logged, prefix, source))
        print(textwrap.fill(f"Definitions: {definition}", 100))


def print_overviews(tables: Sequence[cells.Table]) -> None:
    """Print tables of an evaluation; a pipe that is closed stops nothing."""
    console = Console()
    narrow = console.is_terminal
    if not narrow:  # whoever reads the lines wants to find names in them
        console = Console(width=160)
    with suppress(BrokenPipeError):
        for table in tables:
            console.print(_overview(table, console.width, narrow))


def _overview(table: cells.Table, width: int, narrow: bool) -> Table:
    """Return a table in which the best is bold and the second underlined; long headings may be broken."""
    shown = Table(title=escape(table.title), title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    shown.min_width = min(width, len(table.title))
    shown.add_column(escape(table.corner))
    for column in table.columns:
        shown.add_column(escape(column.replace("_", "_\u200b") if narrow else column), justify="right")
    styles = {1: "bold", 2: "underline"}
    for head, row in table.rows:
        texts = [(escape(cell.text()), styles.get(cell.rank)) for cell in row]
        shown.add_row(escape(head), *(f"[{style}]{text}[/]" if style else text for text, style in texts))
    return shown
