"""Tables of means in Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass


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
    return "".join(_LATEX.get(letter, letter) for letter in text)


_LATEX = {
    **{mark: f"\\{mark}" for mark in "&%_#${}"},
    "\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$",
}  # fmt: skip


def _marked(cell: Cell, marks: Mapping[int, str], sign: str, escape: Callable[[str], str] = str) -> str:
    text = escape(cell.text())
    text = marks.get(cell.rank, "{}").format(text)
    return f"{text}{sign}{cell.interval()}" if cell.interval() else text
