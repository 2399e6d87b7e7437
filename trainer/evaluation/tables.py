"""Tables of an evaluation: means over frames with confidence intervals, ranks, in Markdown, LaTeX and CSV.

The layouts are those of the papers: one row per scene and one column per method (tables 1 and 2 of Fan et
al. 2021), one per number of samples (table 1 of Yu et al. 2021), one row per method (table 1 of Munkberg and
Hasselgren 2020).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from trainer.evaluation.plan import INPUT
from trainer.metrics.measures import SCORES

AVERAGE = "average"
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Cell:
    """A mean over frames.

    Attributes:
        mean: Of the frames that have a value; NaN where none has.
        half: Half the width of the confidence interval; NaN for fewer than two frames.
        count: Frames with a value.
        missing: Frames with a reference that have none: the method failed there, or returned NaN.
        rank: 1 for the best of its group; 0 where it takes no part.
        form: How a value is printed, `{:.2f}`.
    """

    mean: float
    half: float = math.nan
    count: int = 0
    missing: int = 0
    rank: int = 0
    form: str = "{:.4f}"

    def text(self) -> str:
        """Return the mean, with what is missing: `24.31`, `24.31 (2 missing)`, `-`."""
        if not self.count or math.isnan(self.mean):
            return "-" if not self.missing else f"- ({self.missing} missing)"
        text = self.form.format(self.mean)
        return f"{text} ({self.missing} missing)" if self.missing else text

    def interval(self) -> str:
        """Return half the interval as printed, empty where there is none."""
        return "" if math.isnan(self.half) else self.form.format(self.half)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: Of its files.
        title: What it shows, one line.
        corner: Heading of the first column.
        columns: Headings of the others.
        rows: Heading of each row, and its cells.
        notes: What must be known to read it.
    """

    name: str
    title: str
    corner: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the table; the best is bold, the second underlined."""
        marks = {1: "**{}**", 2: "<u>{}</u>"}
        lines = [
            f"### {self.title}",
            "",
            _line([self.corner, *self.columns]),
            _line(["---"] + ["---:"] * len(self.columns)),
        ]
        for head, cells in self.rows:
            lines.append(_line([head, *(_marked(cell, marks, " ± ") for cell in cells)]))
        return "\n".join([*lines, "", *self.notes, ""])

    def latex(self) -> str:
        """Return a `tabular` with booktabs rules; the best is bold, the second underlined."""
        marks = {1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'r' * len(self.columns)}}}", r"\toprule"]
        lines += [" & ".join(map(_escaped, [self.corner, *self.columns])) + r" \\", r"\midrule"]
        for head, cells in self.rows:
            marked = [_marked(cell, marks, r" $\pm$ ", _escaped) for cell in cells]
            lines.append(" & ".join([_escaped(head), *marked]) + r" \\")
        return "\n".join(
            [*lines, r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in self.notes), ""]
        )

    def csv(self) -> str:
        """Return one line per cell: numbers in full, for programs."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([self.corner, "column", "mean", "half_interval", "frames", "missing", "rank"])
        for head, cells in self.rows:
            for column, cell in zip(self.columns, cells, strict=True):
                writer.writerow([head, column, cell.mean, cell.half, cell.count, cell.missing, cell.rank])
        return out.getvalue()


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _escaped(text: str) -> str:
    for mark in "&%_#":
        text = text.replace(mark, f"\\{mark}")
    return text


def _marked(cell: Cell, marks: dict[int, str], sign: str, escape: object = None) -> str:
    text = cell.text()
    if callable(escape):
        text = escape(text)
    text = marks.get(cell.rank, "{}").format(text)
    return f"{text}{sign}{cell.interval()}" if cell.interval() else text


def cell_of(values: pd.Series, expected: int, form: str) -> Cell:
    """Return mean and confidence interval (Student's t) of the frames of a scene.

    Args:
        values: One per frame; NaN where there is none.
        expected: Frames that should have one.
        form: How to print it.
    """
    found = values.dropna().to_numpy(np.float64)
    if not len(found):
        return Cell(math.nan, missing=expected, form=form)
    half = math.nan
    if len(found) > 1:
        half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(found) - 1) * stats.sem(found))
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
        freedom = [cell.count - 1 for cell in there]
        squares = [
            (c.half / stats.t.ppf(0.5 + CONFIDENCE / 2, f)) ** 2 for c, f in zip(there, freedom, strict=True)
        ]
        below = sum(s * s / f for s, f in zip(squares, freedom, strict=True))
        if below > 0:
            reach = stats.t.ppf(0.5 + CONFIDENCE / 2, sum(squares) ** 2 / below)
            half = float(reach * math.sqrt(sum(squares)) / len(there))
        else:
            half = 0.0
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

    def cell(self, method: str, metric: str, scene: str, spp: int | None = None) -> Cell:
        """Return the mean of a scene's frames, those of one sample count where it is given."""
        chosen = self.rows[self.rows["scene"] == scene]
        if spp is not None:
            chosen = chosen[chosen["spp"] == spp]
        # Metrics of successive frames exist for fewer frames, and others not for small images: what any
        # method has is what all should have.
        having = chosen.dropna(subset=[metric])["name"].nunique()
        mine = chosen[chosen["method"] == method]
        return cell_of(mine[metric], having, SCORES[metric].digits)

    def average(self, method: str, metric: str, spp: int | None = None) -> Cell:
        """Return the mean over the scenes."""
        scenes = [
            s for s in self.scenes if spp is None or (self.rows[self.rows["scene"] == s]["spp"] == spp).any()
        ]
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
        return self._table(f"spp_{metric}", f"{metric} per samples per pixel", "samples", metric, rows)

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

PAPERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "wskp": ("As tables 1 and 2 of Fan et al. 2021", ("psnr_wskp", "ssim_wskp")),
    "afgsa": ("As table 1 of Yu et al. 2021", ("rel_mse_half_afgsa", "psnr_afgsa", "ssim_afgsa")),
    "layer": (
        "As table 1 of Munkberg and Hasselgren 2020",
        ("relmse_layer", "smape_wskp", "psnr_layer", "ssim_layer"),
    ),
    "nbgd": (
        "As Meng et al. 2020",
        ("psnr_nbgd", "ssim_nbgd", "rmse_nbgd", "smape_percent_nbgd", "relmse_nbgd"),
    ),
    "perception": (
        "Perception and time",
        ("flip_ldr_srgb", "flip_hdr", "ms_ssim_gamma", "change_gamma", "flicker_gamma"),
    ),
}
"""Name → title and metrics of the tables with one row per method."""


def tables_of(scored: Scored) -> list[Table]:
    """Return all tables: overviews as the papers have them, then every metric per scene and per samples."""
    found = []
    for name, (title, metrics) in PAPERS.items():
        chosen = [
            metric for metric in metrics if metric in scored.metrics and scored.rows[metric].notna().any()
        ]
        if chosen:
            found.append(scored.by_method(chosen, f"overview_{name}", title))
    for metric in scored.metrics:
        if scored.rows[metric].notna().any():
            found.append(scored.by_scene(metric))
            if len(scored.counts) > 1:
                found.append(scored.by_spp(metric))
    return found
