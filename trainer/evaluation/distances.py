"""How far each method is from the best one of every scene (figure 10 of Bitterli et al. 2016).

Values of metrics where less is better are given as multiples of the best method's, the others as differences
from it, so that the best is at 1 or at 0. Means and standard deviations over scenes and numbers of samples
say how much a method falls behind, and how reliably.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from trainer.evaluation.cells import Cell, Table
from trainer.evaluation.plan import INPUT
from trainer.evaluation.tables import Scored, ranked
from trainer.metrics.measures import SCORES


class Distance(NamedTuple):
    """Mean and standard deviation of a method's distances to the best."""

    mean: float
    spread: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Distance:
        """Return those of values; NaN where there are none."""
        if not values:
            return cls(math.nan, math.nan)
        mean = statistics.fmean(values)
        return cls(mean, statistics.pstdev(values) if math.isfinite(mean) else math.nan)


class Panel(NamedTuple):
    """What is drawn of a metric.

    Attributes:
        name: Of the metric.
        higher: Larger is better.
        unit: Of differences.
        values: Method → distances, one for each scene and number of samples.
    """

    name: str
    higher: bool
    unit: str
    values: Mapping[str, Sequence[float]]

    @property
    def finite(self) -> bool:
        """Whether it can be drawn: an error of zero is infinitely better than any other."""
        return all(math.isfinite(value) for values in self.values.values() for value in values)


def distances(
    stills: Sequence[Mapping[str, float]], methods: Sequence[str], higher: bool
) -> dict[str, list[float]]:
    """Return method → distance to the best of these methods, in each still that has all of them.

    Args:
        stills: Method → value of a metric.
        methods: Which are compared.
        higher: Larger is better: differences; otherwise ratios.
    """
    found: dict[str, list[float]] = {method: [] for method in methods}
    for values in stills:
        if not all(math.isfinite(values.get(method, math.nan)) for method in methods):
            continue
        best = (max if higher else min)(values[method] for method in methods)
        for method in methods:
            found[method].append(best - values[method] if higher else _ratio(values[method], best))
    return found


def _ratio(value: float, best: float) -> float:
    return value / best if best > 0 else (1.0 if value == best else math.inf)


def stills_of(scored: Scored, metric: str) -> dict[str, dict[str, float]]:
    """Return scene, and number of samples where there are several → method → mean over its frames."""
    found = {}
    for scene in scored.scenes:
        for spp in scored.counts_of(scene):
            cells = {method: scored.cell(method, metric, scene, spp) for method in scored.methods}
            complete = {m: c.mean for m, c in cells.items() if c.count and not c.missing}
            found[f"{scene}, {spp} spp" if len(scored.counts_of(scene)) > 1 else scene] = complete
    return found


def panel_of(scored: Scored, metric: str) -> Panel | None:
    """Return the distances of all methods but the input; None where no scene has all of at least two."""
    stills = stills_of(scored, metric)
    methods = _taking_part(scored, stills)
    if len(methods) < 2:
        return None
    higher = SCORES[metric].higher
    found = distances(list(stills.values()), methods, higher)
    if not found[methods[0]]:
        return None
    unit = SCORES[metric].format.rpartition("}")[2].strip()
    return Panel(metric, higher, unit if higher else "", found)


def distance_table(scored: Scored, metric: str) -> Table | None:
    """Return one row per scene and number of samples, then mean and deviation; None as `panel_of`."""
    panel = panel_of(scored, metric)
    if panel is None:
        return None
    methods = list(panel.values)
    stills = stills_of(scored, metric)
    heads = [head for head, values in stills.items() if all(method in values for method in methods)]
    rows = [(head, [panel.values[m][i] for m in methods]) for i, head in enumerate(heads)]
    whole = [Distance.of(panel.values[method]) for method in methods]
    rows += [("mean", [d.mean for d in whole]), ("standard deviation", [d.spread for d in whole])]
    kind = f"best {metric} - {metric}" if panel.higher else f"{metric} / best {metric}"
    title = f"Distance to the best method per scene, {kind}, lower is better"
    notes = (
        "As figure 10 of Bitterli et al. 2016. Scenes that lack a method, and methods that lack all scenes, "
        "are left out; the best is bold, the second underlined.",
    )
    form = SCORES[metric].digits if panel.higher else "{:.3f}"
    cells = tuple((head, _ranked(values, form)) for head, values in rows)
    return Table(f"distance_{metric}", title, "scene", tuple(methods), cells, notes)


def _taking_part(scored: Scored, stills: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the methods that have some scene; one that failed everywhere must not hide the others."""
    return [m for m in scored.methods if m != INPUT and any(m in values for values in stills.values())]


def _ranked(values: Sequence[float], form: str) -> tuple[Cell, ...]:
    cells: list[Any] = [Cell(value, count=1, form=form) for value in values]
    return tuple(ranked(cells, False, [True] * len(cells)))
