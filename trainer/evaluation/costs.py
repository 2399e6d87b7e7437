"""Time and memory per megapixel of each method, measured in processes of their own, and the table of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd

from trainer.evaluation.cells import Cell, Table
from trainer.evaluation.plan import INPUT, Setting
from trainer.evaluation.running import Outcome
from trainer.evaluation.tables import ranked
from trainer.outputs import replacing

COSTS = "costs.json"
SMALLEST = 64
"""Sides of the image that is measured are at least so long: shorter ones measure the calls."""


def costs_of(
    outcomes: Sequence[Outcome], rows: pd.DataFrame, setting: Setting, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Return label → cost of every method that was done; what was measured before is not measured again.

    The image has the median size of the frames.

    Args:
        outcomes: Of all methods.
        rows: One per frame and method.
        setting: How they were run.
        say: Told what is measured, and why something could not be.

    Raises:
        OSError: They cannot be written.
    """
    from trainer.benchmarking import cost

    if rows["width"].isna().all():
        return {}  # no frame could be read
    size = (max(SMALLEST, int(rows["width"].median())), max(SMALLEST, int(rows["height"].median())))
    spp = int(rows["spp"].median()) if rows["spp"].notna().any() else 8
    path = setting.folder / COSTS
    known: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    found: dict[str, dict[str, Any]] = {}
    for outcome in outcomes:
        label = outcome.method.label
        if label == INPUT or outcome.status == "skipped":
            continue
        key = json.dumps([label, outcome.facts, size, spp, setting.device, setting.memory])
        if key not in known:
            say(f"measuring time and memory of {label} at {size[0]}x{size[1]}")
            try:
                model, options = outcome.method.model, outcome.method.options
                taken = cost(model, options, size, setting.device, spp=spp, memory=setting.memory)
            except ValueError as error:
                say(f"{label}: time and memory were not measured: {error}")
                continue
            known[key] = asdict(taken)
            with replacing(path) as temporary:
                temporary.write_text(json.dumps(known, indent=1))
        found[label] = known[key]
    return found


def cost_table(costs: dict[str, dict[str, Any]], outcomes: Sequence[Outcome]) -> Table | None:
    """Return a table of time, memory and size, None where nothing was measured."""
    shown = [outcome for outcome in outcomes if outcome.method.label in costs]
    if not shown:
        return None
    every = [costs[outcome.method.label] for outcome in shown]
    seconds = [
        Cell(c["seconds_per_megapixel"], (c["spread"][1] - c["spread"][0]) / 2, c["calls"], form="{:.3f}")
        for c in every
    ]
    memory = [Cell(c["peak_bytes_per_megapixel"] / 1e6, count=1, form="{:.0f}") for c in every]
    sizes = [_parameters(outcome) for outcome in shown]
    columns = [ranked(cells, False, [True] * len(shown)) for cells in (seconds, memory)] + [sizes]
    rows = tuple(
        (outcome.method.label, tuple(column[i] for column in columns)) for i, outcome in enumerate(shown)
    )
    first = every[0]
    where = f"{first['device']}, {first['threads']} threads" if first["device"] == "cpu" else first["device"]
    notes = (
        f"Inference on one image, {where}, each method in a process of its own, warm: median of its calls ± "
        "half the distance of the quartiles; memory beside the model and the image.",
    )
    heads = ("s per megapixel ↓", "MB per megapixel ↓", "parameters")
    return Table("overview_cost", "Time and memory", "method", heads, rows, notes)


def _parameters(outcome: Outcome) -> Cell:
    number = outcome.facts.get("deployed")
    return Cell(float(number), count=1, form="{:,.0f}") if number is not None else Cell(float("nan"))
