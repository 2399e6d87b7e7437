"""Curves of an ablation, after figure 10 of Fan et al. 2021: quality, and time of a frame, over a number."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from trainer.ablation.plan import CURVE, Ablation, Layout
from trainer.ablation.tables import Measured
from trainer.evaluation.cells import Cell
from trainer.metrics.measures import SCORES
from trainer.outputs import replacing

SUFFIXES = (".png", ".pdf")


def write_plots(folder: Path, ablation: Ablation, measured: Measured) -> list[Path]:
    """Draw every curve that has values into `plots`, as PNG and PDF; returns the files.

    Raises:
        OSError: A file cannot be written.
    """
    place = folder / "plots"
    place.mkdir(exist_ok=True)
    written = []
    for name, layout in ablation.layouts.items():
        if layout.kind != CURVE or (figure := curve_figure(ablation, layout, measured)) is None:
            continue
        for suffix in SUFFIXES:
            written.append(place / f"{name}{suffix}")
            with replacing(written[-1]) as partial:
                figure.savefig(partial, dpi=110)
    return written


class Panel(NamedTuple):
    """One axis of a figure.

    Attributes:
        label: What is drawn.
        points: Number on the axis, and its value.
        color: Of the line.
        spread: Whether the spread of values is drawn. Metrics are those of the same frames for all variants,
            so that theirs says nothing of a difference.
    """

    label: str
    points: list[tuple[float, Cell]]
    color: str
    spread: bool


def curve_figure(ablation: Ablation, layout: Layout, measured: Measured) -> Any:
    """Return a figure with the first metric on the left and time on the right; None without any value."""
    from matplotlib.figure import Figure

    panels = [panel for panel in _panels(ablation, layout, measured) if panel.points]
    if not panels:
        return None
    figure = Figure(figsize=(4.8 * len(panels), 3.9), layout="constrained")
    figure.suptitle(layout.title, fontsize=11, weight="bold")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels, strict=True):
        places = [x for x, _ in panel.points]
        bars = [cell.half for _, cell in panel.points] if panel.spread else None
        values = [cell.mean for _, cell in panel.points]
        axes.errorbar(places, values, yerr=bars, fmt="o-", capsize=3, color=panel.color)
        axes.set_xticks(places)
        axes.set_xlabel(layout.axis)
        axes.set_ylabel(panel.label)
        axes.grid(color="#dddddd", linewidth=0.6)
        if panel.spread:
            axes.set_ylim(bottom=0)
    return figure


def _panels(ablation: Ablation, layout: Layout, measured: Measured) -> list[Panel]:
    scored, metric, (width, height) = measured.scored, ablation.metrics[0], measured.size
    placed = [(x, v.name) for v, x in ablation.placed(layout.name) if v.name in scored.methods]
    quality = [(x, scored.average(name, metric)) for x, name in placed]
    times = [(x, measured.milliseconds(name)) for x, name in placed]
    arrow = "higher is better" if SCORES[metric].higher else "lower is better"
    return [
        Panel(f"{metric}, {arrow}", _there(quality), "tab:blue", False),
        Panel(f"ms per frame of {width}x{height}", _there(times), "tab:orange", True),
    ]


def _there(points: list[tuple[float, Cell]]) -> list[tuple[float, Cell]]:
    return [point for point in points if point[1].count]
