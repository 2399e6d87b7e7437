"""Tables of an ablation: every variant, pairs as table 5 of Fan et al. 2021 has them, and curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from trainer.ablation.plan import OVERVIEW, PAIRS, Ablation, Layout, Variant
from trainer.evaluation.cells import Cell, Table
from trainer.evaluation.plan import INPUT
from trainer.evaluation.tables import AVERAGE, NOTE, Scored, ranked
from trainer.metrics.measures import SCORES
from trainer.outputs import replacing

MILLISECONDS = "{:.1f}"
BUSY = 0.1
"""Share of all cores that other programs may take without a word: times are too long where it is large."""


@dataclass(frozen=True)
class Measured:
    """What is known of the variants that were evaluated.

    Attributes:
        scored: Metrics of the frames, by name of the variant.
        costs: Name → what `trainer.benchmarking.cost` measured, of those that were measured.
        numbers: Name → parameters of the network in training and deployed, and the training step whose
            weights were evaluated (the best in validation); None where that is not known.
        size: Width and height of the frames.
        device: Where time was measured.
        failed: Name → why there is nothing of it, or not all.
    """

    scored: Scored
    costs: Mapping[str, Mapping[str, Any]]
    numbers: Mapping[str, tuple[int | None, int | None, int | None]]
    size: tuple[int, int]
    device: str
    failed: Mapping[str, str]

    @staticmethod
    def of(
        rows: pd.DataFrame, record: Mapping[str, Any], metrics: Sequence[str], failed: Mapping[str, str]
    ) -> Measured:
        """Return what an evaluation holds.

        Args:
            rows: Its `rows.parquet`.
            record: Its `evaluation.json`.
            metrics: Those of the tables.
            failed: Name → why a variant was not evaluated.
        """
        methods = record["methods"]
        frames = rows[rows["method"] == INPUT]
        costs = {m["label"]: m["cost"] for m in methods if m["cost"]}
        lost = {m["label"]: str(m["reason"]) for m in methods if m["status"] != "done" or m["reason"]}
        return Measured(
            Scored(rows, [INPUT, *(m["label"] for m in methods)], metrics),
            costs,
            {m["label"]: (m["parameters"], m["deployed"], m.get("step")) for m in methods},
            (int(frames["width"].median()), int(frames["height"].median())),
            " or ".join(dict.fromkeys(_place(cost) for cost in costs.values())),
            {**failed, **lost},
        )

    def milliseconds(self, name: str) -> Cell:
        """Return the time of a frame, ± half the distance of the quartiles."""
        cost = self.costs.get(name)
        if cost is None:
            return Cell(math.nan, form=MILLISECONDS)
        pixels = self.size[0] * self.size[1] / 1e6
        low, high = cost["spread"]
        median = 1e3 * pixels * cost["seconds_per_megapixel"]
        return Cell(median, 500 * pixels * (high - low), 1, form=MILLISECONDS)

    def timing(self) -> str:
        """Return what must be known of the times."""
        others = max((float(cost["others"]) for cost in self.costs.values()), default=0.0)
        busy = f" Other programs took up to {others:.0%} of all cores meanwhile." if others > BUSY else ""
        return (
            f"Time of a frame of {self.size[0]}x{self.size[1]} pixels with the deployed network, "
            f"{self.device}, warm, in a process of its own: median ± half the distance of the quartiles."
            + busy
        )


def _place(cost: Mapping[str, Any]) -> str:
    """Return where a time was measured; an earlier call may have had another number of threads."""
    threads = f", {cost['threads']} thread{'s' * (cost['threads'] != 1)}"
    return f"{cost['device']}{threads if cost['device'] == 'cpu' else ''}"


def tables_of(ablation: Ablation, measured: Measured) -> list[Table]:
    """Return a table of all variants, and one for each layout that has any of them."""
    found = [overview(ablation, measured)]
    for name, layout in ablation.layouts.items():
        if ablation.placed(name):
            table = pairs if layout.kind == PAIRS else curve
            found.append(table(ablation, layout, measured))
    return found


def write_tables(folder: Path, tables: Sequence[Table]) -> None:
    """Write tables as Markdown, LaTeX and CSV into `tables`.

    Raises:
        OSError: One cannot be written.
    """
    place = folder / "tables"
    place.mkdir(exist_ok=True)
    for table in tables:
        for suffix, text in ((".md", table.markdown()), (".tex", table.latex()), (".csv", table.csv())):
            with replacing(place / f"{table.name}{suffix}") as path:
                path.write_text(text)


def overview(ablation: Ablation, measured: Measured) -> Table:
    """Return one row for each variant: metrics averaged over scenes, parameters, step, time of a frame."""
    names = [variant.name for variant in ablation.variants]
    rows, notes = _by_variant([INPUT, *names], measured), [NOTE, STEP_NOTE, measured.timing()]
    numbers = [measured.numbers.get(name, (None, None, None)) for name in (INPUT, *names)]
    table = tuple(
        (name, (*cells[:-1], *(_number(number) for number in own), cells[-1]))
        for (name, cells), own in zip(rows, numbers, strict=True)
    )
    notes += [f"{name}: {reason}" for name, reason in measured.failed.items()]
    heads = (*_heads(measured), "parameters", "deployed", "step", "ms per frame ↓")
    return Table(OVERVIEW, ablation.title, "variant", heads, table, tuple(notes))


def curve(ablation: Ablation, layout: Layout, measured: Measured) -> Table:
    """Return one row for each place on the axis: metrics and time of a frame."""
    placed = ablation.placed(layout.name)
    rows = _by_variant([variant.name for variant, _ in placed], measured)
    named = tuple(
        (f"{place:g} ({name})", cells) for (_, place), (name, cells) in zip(placed, rows, strict=True)
    )
    heads = (*_heads(measured), "ms per frame ↓")
    return Table(layout.name, layout.title, layout.axis, heads, named, (NOTE, measured.timing()))


def pairs(ablation: Ablation, layout: Layout, measured: Measured) -> Table:
    """Return a row for each scene and row of the layout, a column for each metric and column of it."""
    placed: dict[tuple[str, str], Variant] = {
        place: variant for variant, place in ablation.placed(layout.name)
    }
    columns = list(dict.fromkeys(column for _, column in placed))
    scored = measured.scored
    scenes = [*scored.scenes, *([AVERAGE] if len(scored.scenes) > 1 else [])]
    rows = []
    for row in dict.fromkeys(row for row, _ in placed):
        for scene in scenes:
            cells: list[Cell] = []
            for metric in scored.metrics:
                variants = [placed.get((row, column)) for column in columns]
                own = [_cell(scored, variant.name if variant else "", metric, scene) for variant in variants]
                cells += ranked(own, SCORES[metric].higher, [True] * len(own))
            rows.append((f"{scene} ({row})", tuple(cells)))
    heads = tuple(f"{head} {column}" for head in _heads(measured) for column in columns)
    return Table(layout.name, layout.title, "scene", heads, tuple(rows), (PAIRS_NOTE,))


STEP_NOTE = "step: of the weights that were compared, the best of the training in validation."

PAIRS_NOTE = (
    "Means over the frames of a scene, ± 95 % confidence over frames; of each pair the better one is bold."
)


def _by_variant(names: Sequence[str], measured: Measured) -> list[tuple[str, tuple[Cell, ...]]]:
    """Return name → metrics and time; the input takes no part in the ranks."""
    scored, part = measured.scored, [name != INPUT for name in names]
    columns = [
        ranked([_cell(scored, name, metric, AVERAGE) for name in names], SCORES[metric].higher, part)
        for metric in scored.metrics
    ]
    columns.append(ranked([measured.milliseconds(name) for name in names], False, part))
    return [(name, tuple(column[i] for column in columns)) for i, name in enumerate(names)]


def _cell(scored: Scored, name: str, metric: str, scene: str) -> Cell:
    """Return a mean of a variant, without a value where it was not evaluated."""
    if name not in scored.methods:
        return Cell(math.nan, form=SCORES[metric].digits)
    return scored.average(name, metric) if scene == AVERAGE else scored.cell(name, metric, scene)


def _heads(measured: Measured) -> tuple[str, ...]:
    return tuple(f"{metric} {'↑' if SCORES[metric].higher else '↓'}" for metric in measured.scored.metrics)


def _number(value: int | None) -> Cell:
    return Cell(math.nan) if value is None else Cell(float(value), count=1, form="{:,.0f}")
