"""Plots of an evaluation as files, for papers and for the tracking store: each as PNG and as PDF.

distance.*               figure 10 of Bitterli et al. 2016: how far methods are from the best per scene
convergence_METRIC.*     figure 5 of Yu et al. 2021: a metric over the number of samples
time_METRIC.*            a metric over time per megapixel, with the Pareto front
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from trainer.evaluation.distances import Distance, Panel, panel_of
from trainer.evaluation.layouts import LEAD
from trainer.evaluation.plan import INPUT
from trainer.evaluation.tables import Scored
from trainer.metrics.measures import SCORES
from trainer.outputs import replacing
from trainer.reports.front import on_front

SUFFIXES = (".png", ".pdf")

_STEPS = {
    1.3: (1, 1.02, 1.05, 1.1, 1.15, 1.2, 1.25),
    10: (1, 1.25, 1.5, 2, 3, 5, 7),
    math.inf: tuple(step * 10**power for power in range(8) for step in (1, 2, 5)),
}
"""End of an axis of ratios → where it has numbers."""
_LABEL = 28
"""Letters of a name that fit beside a point."""
_MARKERS = "osD^vP*X"


def write_plots(
    folder: Path, rows: pd.DataFrame, scored: Scored, costs: Mapping[str, Mapping[str, Any]]
) -> list[Path]:
    """Draw what the rows allow into `plots` and return the files; older plots there are removed.

    Args:
        folder: Of the evaluation.
        rows: One per frame and method.
        scored: The same.
        costs: Label → time per megapixel; of methods without, the median over the frames counts.

    Raises:
        OSError: A file cannot be written.
    """
    from matplotlib.figure import Figure

    place = folder / "plots"
    place.mkdir(exist_ok=True)
    for old in place.iterdir():
        if old.suffix in SUFFIXES:
            old.unlink()
    written = []
    for name, figure in _figures(rows, scored, costs):
        assert isinstance(figure, Figure)
        for suffix in SUFFIXES:
            written.append(place / f"{name}{suffix}")
            with replacing(written[-1]) as partial:
                figure.savefig(partial, dpi=110)
    return written


def _figures(
    rows: pd.DataFrame, scored: Scored, costs: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, Any]]:
    lead = [metric for metric in LEAD if metric in scored.metrics]
    panels = [panel for panel in (panel_of(scored, metric) for metric in lead) if panel and panel.finite]
    if panels:
        yield "distance", distance_figure({"": panels})
    seconds = {label: _seconds(rows, label, costs) for label in scored.methods if label != INPUT}
    for metric in lead:
        if len(scored.counts) > 1:
            yield f"convergence_{metric}", convergence_figure(scored, metric)
        if points := points_of(scored, metric, seconds):
            yield f"time_{metric}", time_figure(points, metric)


def distance_figure(blocks: Mapping[str, Sequence[Panel]]) -> Any:
    """Return a figure with one row of panels per block (title → panels).

    A thin line is one scene at one number of samples; dots are means, bars one standard deviation.
    """
    from matplotlib.figure import Figure

    columns = max(len(panels) for panels in blocks.values())
    figure = Figure(figsize=(3.75 * columns, 5.2 * len(blocks)), layout="constrained")
    for part, (title, panels) in zip(
        figure.subfigures(len(blocks), squeeze=False).flat, blocks.items(), strict=True
    ):
        count = len(next(iter(panels[0].values.values())))
        told = f"{title}: " if title else ""
        part.suptitle(
            f"{told}{count} scene{'s' * (count != 1)}; lines: scenes, dots: means, bars: standard deviation",
            weight="bold",
            fontsize=11,
        )
        for axes, panel in zip(part.subplots(1, len(panels), squeeze=False).flat, panels, strict=True):
            _distances(axes, panel)
    return figure


def _distances(axes: Any, panel: Panel) -> None:
    methods = list(panel.values)
    table = [Distance.of(panel.values[method]) for method in methods]
    places = range(len(methods))
    for line in zip(*panel.values.values(), strict=True):
        axes.plot(places, line, color="#4f86c6", linewidth=0.6, alpha=0.6, zorder=1)
    best = 0 if panel.higher else 1
    # Nothing is better than the best: bars end there.
    low = [min(entry.spread, entry.mean - best) for entry in table]
    bars = {"fmt": "o", "color": "#b3261e", "capsize": 5, "linewidth": 1.6, "zorder": 3}
    axes.errorbar(places, [d.mean for d in table], yerr=[low, [d.spread for d in table]], **bars)
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    for place, entry in zip(places, table, strict=True):
        text = f"{entry.mean:.3g}" if entry.mean >= 0.01 else f"{entry.mean:.4f}"
        axes.annotate(text, (place + 0.12, entry.mean), fontsize=8, va="center", bbox=box, zorder=4)
    axes.set_xticks(list(places), [_short(method) for method in methods], rotation=30, ha="right")
    axes.set_xlim(-0.4, len(methods) - 0.1)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6, which="both")
    if panel.higher:
        axes.invert_yaxis()
        unit = f" [{panel.unit}]" if panel.unit else ""
        axes.set_title(panel.name, fontsize=10)
        axes.set_ylabel(f"below the best{unit}")
    else:
        _logarithmic(axes)
        axes.set_title(panel.name, fontsize=10)
        axes.set_ylabel("times the best, logarithmic")


def _logarithmic(axes: Any) -> None:
    """Make the axis of values logarithmic, with plain numbers on it."""
    from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = next(steps for end, steps in _STEPS.items() if high < end)
    every = 3 if high > 1e4 else 1
    axes.yaxis.set_major_locator(FixedLocator([step for step in steps if low <= step <= high][::every]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())


def convergence_figure(scored: Scored, metric: str) -> Any:
    """Return a figure of a metric, averaged over scenes, over the number of samples per pixel."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator, StrMethodFormatter

    figure = Figure(figsize=(7, 4.6), layout="constrained")
    axes = figure.subplots()
    for number, label in enumerate(scored.methods):
        cells = [scored.average(label, metric, spp) for spp in scored.counts]
        found = [(spp, c) for spp, c in zip(scored.counts, cells, strict=True) if c.count and not c.missing]
        if not found:
            continue
        points, values = [spp for spp, _ in found], [cell.mean for _, cell in found]
        spread = [0 if math.isnan(cell.half) else cell.half for _, cell in found]
        look: dict[str, Any] = {"color": "#777777", "linestyle": "--"} if label == INPUT else {}
        marker = _MARKERS[number % len(_MARKERS)]
        axes.errorbar(points, values, yerr=spread, label=_short(label), marker=marker, capsize=3, **look)
    axes.set_xscale("log", base=2)
    axes.set_xticks(scored.counts)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    higher = SCORES[metric].higher
    if not higher:
        axes.set_yscale("log")
    axes.set_xlabel("samples per pixel")
    axes.set_ylabel(f"{metric}, {'higher' if higher else 'lower'} is better")
    axes.grid(color="#dddddd", linewidth=0.6, which="both")
    axes.legend(fontsize=9)
    return figure


class Point(NamedTuple):
    """A method by its time per megapixel and its mean, with half the confidence interval."""

    seconds: float
    value: float
    half: float
    label: str


def points_of(scored: Scored, metric: str, seconds: Mapping[str, float]) -> list[Point]:
    """Return the methods whose time (label → seconds per megapixel) and metric on every frame are known."""
    found = []
    for label, time in seconds.items():
        cell = scored.average(label, metric)
        if cell.count and not cell.missing and math.isfinite(time) and math.isfinite(cell.mean):
            found.append(Point(time, cell.mean, 0 if math.isnan(cell.half) else cell.half, label))
    return found


def time_figure(points: Sequence[Point], metric: str) -> Any:
    """Return a figure of a metric over time; the Pareto front is a line."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    figure = Figure(figsize=(7, 4.6), layout="constrained")
    axes = figure.subplots()
    higher = SCORES[metric].higher
    front = pareto([(point.seconds, point.value) for point in points], higher)
    axes.plot(*zip(*front, strict=True), "o-", ms=12, mfc="none", color="tab:orange", label="Pareto front")
    low, high = min(point.seconds for point in points), max(point.seconds for point in points)
    for point in points:
        place = point.seconds, point.value
        axes.errorbar(*place, yerr=point.half, fmt="o", color="tab:blue", capsize=3)
        # Names lie towards the middle of the picture.
        right = high > low and math.log(point.seconds / low) > 0.6 * math.log(high / low)
        side: dict[str, Any] = {"xytext": (-6, 6), "ha": "right"} if right else {"xytext": (6, 6)}
        axes.annotate(_short(point.label), place, fontsize=8, textcoords="offset points", **side)
    axes.set_xscale("log")
    axes.margins(x=0.25)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(_between(points))
    axes.set_xlabel("seconds per megapixel")
    axes.set_ylabel(f"{metric}, {'higher' if higher else 'lower'} is better")
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.legend(fontsize=9)
    return figure


def _between(points: Sequence[Point]) -> Any:
    """Return what writes numbers between the powers of ten: all where times lie close together."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    times = [point.seconds for point in points]
    return StrMethodFormatter("{x:g}") if max(times) < 10 * min(times) else NullFormatter()


def _short(label: str) -> str:
    return label if len(label) <= _LABEL else f"{label[: _LABEL - 1]}…"


def pareto(points: Sequence[tuple[float, float]], higher: bool) -> list[tuple[float, float]]:
    """Return the points (time, value) that no other one beats in both, by time."""
    sign = -1.0 if higher else 1.0
    flags = on_front([(time, sign * value) for time, value in points])
    return sorted({point for point, on in zip(points, flags, strict=True) if on})


def _seconds(rows: pd.DataFrame, label: str, costs: Mapping[str, Mapping[str, Any]]) -> float:
    if label in costs:
        return float(costs[label]["seconds_per_megapixel"])
    own = rows[(rows["method"] == label) & (rows["status"] != "failed")]
    pixels = own["width"].astype(float) * own["height"].astype(float) / 1e6
    return float((own["seconds"].astype(float) / pixels).median())
