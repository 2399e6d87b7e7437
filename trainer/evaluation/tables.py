"""Tables of an evaluation: means over frames with confidence intervals, ranks.

The layouts are those of the papers: one row per scene and one column per method (tables 1 and 2 of Fan et
al. 2021), one per number of samples (table 1 of Yu et al. 2021), one row per method (table 1 of Munkberg and
Hasselgren 2020).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit

from trainer.evaluation.cells import Cell, Table
from trainer.evaluation.plan import INPUT
from trainer.metrics.measures import SCORES

AVERAGE = "average"
CONFIDENCE = 0.95
Places = NDArray[np.intp]


@cache
def _reach(freedom: float) -> float:
    """Return how many standard errors the confidence interval reaches to either side (Student's t)."""
    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def cell_of(values: NDArray[np.float64], expected: int, form: str) -> Cell:
    """Return mean and confidence interval (Student's t) of the frames of a scene.

    Args:
        values: One per frame; NaN where there is none.
        expected: Frames that should have one.
        form: How to print it.
    """
    found = values[~np.isnan(values)]
    if not len(found):
        return Cell(math.nan, missing=expected, form=form)
    half = math.nan
    if len(found) > 1:
        half = _reach(len(found) - 1) * float(found.std(ddof=1)) / math.sqrt(len(found))
    return Cell(float(found.mean()), half, len(found), max(0, expected - len(found)), form=form)


def average_of(cells: Sequence[Cell], form: str) -> Cell:
    """Return the mean of scenes' means, each scene with the same weight, and its confidence interval.

    The interval is over frames with the scenes as they are: the variance of the mean is the sum of those of
    the scenes' means, with the degrees of freedom of Welch and Satterthwaite.
    """
    there = [cell for cell in cells if cell.count]
    missing = sum(cell.missing for cell in cells)
    if not there:
        return Cell(math.nan, missing=missing, form=form)
    mean = float(np.mean([cell.mean for cell in there]))
    half = math.nan
    if all(cell.count > 1 for cell in there):
        squares = [(cell.half / _reach(cell.count - 1)) ** 2 for cell in there]
        below = sum(s * s / (cell.count - 1) for s, cell in zip(squares, there, strict=True))
        freedom = sum(squares) ** 2 / below if below > 0 else 1.0
        half = _reach(freedom) * math.sqrt(sum(squares)) / len(there)
    return Cell(mean, half, sum(cell.count for cell in there), missing, form=form)


def ranked(cells: Sequence[Cell], higher: bool, taking_part: Sequence[bool]) -> list[Cell]:
    """Return cells with their ranks: complete ones before those that lack frames; equal ones share a rank."""

    def key(cell: Cell) -> tuple[bool, float]:
        printed = float(cell.form.format(cell.mean).split()[0])  # what looks equal is equal
        return cell.missing > 0, -printed if higher else printed

    keys = [key(c) if part and c.count else None for c, part in zip(cells, taking_part, strict=True)]
    order = sorted({k for k in keys if k is not None})
    return [
        Cell(c.mean, c.half, c.count, c.missing, 0 if k is None else order.index(k) + 1, c.form)
        for c, k in zip(cells, keys, strict=True)
    ]


class Scored:
    """The rows of an evaluation.

    Args:
        rows: One per frame and method, as `rows.parquet` has them.
        methods: Labels in order, `input` first.
        metrics: Names, in order.
    """

    def __init__(self, rows: pd.DataFrame, methods: Sequence[str], metrics: Sequence[str]) -> None:
        self.rows = rows[rows["reference"].astype(bool)]
        self.methods, self.metrics = list(methods), list(metrics)
        self.scenes = list(dict.fromkeys(self.rows["scene"]))
        self.counts = sorted({int(spp) for spp in self.rows["spp"].dropna()})
        self._values = self.rows[self.metrics].to_numpy(np.float64)
        self._spp = self.rows["spp"].to_numpy(np.float64, na_value=np.nan)
        self._names = self.rows["name"].factorize()[0]
        self._places: dict[tuple[str, str], Places] = self.rows.groupby(["method", "scene"]).indices
        self._having: dict[tuple[str, int | None], NDArray[np.intp]] = {}

    def counts_of(self, scene: str) -> list[int | None]:
        """Return the numbers of samples per pixel that a scene has, None alone where it says none."""
        spp = self.rows.loc[self.rows["scene"] == scene, "spp"].dropna()
        return [*sorted({int(number) for number in spp})] or [None]

    def cell(self, method: str, metric: str, scene: str, spp: int | None = None) -> Cell:
        """Return the mean of a scene's frames, those of one sample count where it is given."""
        column = self.metrics.index(metric)
        mine = self._chosen(method, scene, spp)
        expected = int(self._expected(scene, spp)[column])
        return cell_of(self._values[mine, column], expected, SCORES[metric].digits)

    def _chosen(self, method: str, scene: str, spp: int | None) -> Places:
        found = self._places.get((method, scene), np.empty(0, np.intp))
        return found if spp is None else found[self._spp[found] == spp]

    def _expected(self, scene: str, spp: int | None) -> NDArray[np.intp]:
        """Return how many frames should have each metric.

        Those of successive frames exist for fewer frames, others not for small images: what any method has is
        what all should have.
        """
        if (scene, spp) not in self._having:
            rows = np.concatenate([self._chosen(method, scene, spp) for method in self.methods])
            there = np.zeros((int(self._names.max(initial=-1)) + 1, len(self.metrics)), bool)
            np.logical_or.at(there, self._names[rows], ~np.isnan(self._values[rows]))
            self._having[scene, spp] = there.sum(0)
        return self._having[scene, spp]

    def average(self, method: str, metric: str, spp: int | None = None) -> Cell:
        """Return the mean over the scenes; of one sample count, over those that have all counts.

        Other scenes at each count would make of their differences one of the counts. Where no scene has all,
        those that have the count are taken.
        """
        scenes = self.scenes
        if spp is not None:
            every = [s for s in self.scenes if self.counts_of(s) == self.counts]
            scenes = every or [s for s in self.scenes if spp in self.counts_of(s)]
        cells = [self.cell(method, metric, scene, spp) for scene in scenes]
        return average_of(cells, SCORES[metric].digits)

    def by_scene(self, metric: str) -> Table:
        """Return one row per scene and their average, one column per method."""
        rows = [(scene, [self.cell(m, metric, scene) for m in self.methods]) for scene in self.scenes]
        rows.append((AVERAGE, [self.average(m, metric) for m in self.methods]))
        return self._table(f"scenes_{metric}", f"{metric} per scene", "scene", metric, rows)

    def by_spp(self, metric: str) -> Table:
        """Return one row per number of samples, one column per method."""
        rows = [(f"{n} spp", [self.average(m, metric, n) for m in self.methods]) for n in self.counts]
        title = f"{metric} per samples per pixel, of the scenes that have all of these"
        return self._table(f"spp_{metric}", title, "samples", metric, rows)

    def _table(
        self, name: str, title: str, corner: str, metric: str, rows: Iterable[tuple[str, list[Cell]]]
    ) -> Table:
        score = SCORES[metric]
        part = [method != INPUT for method in self.methods]
        arrow = "higher is better" if score.higher else "lower is better"
        done = tuple((head, tuple(ranked(cells, score.higher, part))) for head, cells in rows)
        return Table(
            name, f"{title}, {arrow}", corner, tuple(self.methods), done, (f"{metric}: {score.doc}", NOTE)
        )

    def by_method(self, metrics: Sequence[str], name: str, title: str) -> Table:
        """Return one row per method, one column per metric, averaged over scenes."""
        columns = {}
        part = [method != INPUT for method in self.methods]
        for metric in metrics:
            cells = [self.average(method, metric) for method in self.methods]
            columns[metric] = ranked(cells, SCORES[metric].higher, part)
        rows = tuple((m, tuple(columns[k][i] for k in metrics)) for i, m in enumerate(self.methods))
        heads = tuple(f"{metric} {'↑' if SCORES[metric].higher else '↓'}" for metric in metrics)
        return Table(name, title, "method", heads, rows, (NOTE,))


NOTE = (
    "Means over the frames of each scene, averages over scenes, ± 95 % confidence over frames; the best is "
    "bold, the second underlined, the input takes no part."
)
