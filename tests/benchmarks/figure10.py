"""Figure 10 of NFOR: how far each method is from the best one, per metric, over all stills.

A thin line is one still at one number of samples per pixel; dots are means, bars one standard deviation on
either side. MSE and relMSE are given as multiples of the best method's value (logarithmic axis), PSNR and
SSIM as differences from it, so that the best is at 1 or at 0.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

Scores = Mapping[str, Mapping[str, float]]
"""Method → metric → value, of one still."""

RATIO, DIFFERENCE = "times the best", "below the best"
METRICS = {"MSE": RATIO, "relMSE": RATIO, "PSNR": DIFFERENCE, "SSIM": DIFFERENCE}
UNITS = {"MSE": "", "relMSE": "", "PSNR": " dB", "SSIM": ""}


class Distance(NamedTuple):
    """Mean and standard deviation of a method's distance to the best of each still."""

    mean: float
    spread: float


def distances(stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> dict[str, list[float]]:
    """Return method → distance to the best of these methods; stills that lack one of them are left out."""
    found: dict[str, list[float]] = {method: [] for method in methods}
    for scores in stills:
        if any(method not in scores for method in methods):
            continue
        values = {method: scores[method][metric] for method in methods}
        for method, value in values.items():
            if METRICS[metric] == RATIO:
                found[method].append(value / min(values.values()))
            else:
                found[method].append(max(values.values()) - value)
    return found


def summary(stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> dict[str, Distance]:
    """Return method → mean and standard deviation of its distances."""
    return {
        method: Distance(statistics.fmean(values), statistics.pstdev(values))
        for method, values in distances(stills, metric, methods).items()
    }


def verdict(stills: Sequence[Scores], metric: str, methods: Sequence[str], ours: Sequence[str]) -> str:
    """Return a sentence: whether the best mean and the least spread belong to one of `ours`."""
    table = summary(stills, metric, methods)
    unit = UNITS[metric]

    def told(what: str, of: Mapping[str, float]) -> str:
        first = min(of, key=lambda method: of[method])
        mine = min(ours, key=lambda method: of[method])
        if first in ours:
            others = {method: value for method, value in of.items() if method not in ours}
            next_best = min(others, key=lambda method: others[method])
            return (
                f"{what} {of[first]:.3g}{unit} of {first} (next {next_best}, {others[next_best]:.3g}{unit})"
            )
        return f"{what} {of[first]:.3g}{unit} of {first}, NOT of NFOR ({mine}, {of[mine]:.3g}{unit})"

    means = {method: entry.mean for method, entry in table.items()}
    spreads = {method: entry.spread for method, entry in table.items()}
    best, least = (min(of, key=lambda method: of[method]) in ours for of in (means, spreads))
    answer = {(True, True): "both", (True, False): "the mean only", (False, True): "the spread only"}
    return (
        f"{metric}, distance to the best: NFOR leads in {answer.get((best, least), 'neither')}: "
        f"{told('least mean', means)}; {told('least standard deviation', spreads)}"
    )


def draw(blocks: Mapping[str, Sequence[Scores]], methods: Sequence[str], path: Path) -> None:
    """Draw one row of panels per block (title → stills) into a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(15, 5.2 * len(blocks)), layout="constrained")
    parts = figure.subfigures(len(blocks), squeeze=False).flat
    for part, (title, stills) in zip(parts, blocks.items(), strict=True):
        count = len(distances(stills, "MSE", methods)[methods[0]])
        part.suptitle(
            f"{title}: {count} stills; lines: stills, dots: means, bars: standard deviation", weight="bold"
        )
        for panel, metric in zip(part.subplots(1, len(METRICS)), METRICS, strict=True):
            _panel(panel, stills, metric, methods)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(panel: Any, stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> None:
    found = distances(stills, metric, methods)
    table = summary(stills, metric, methods)
    places = range(len(methods))
    for line in zip(*found.values(), strict=True):
        panel.plot(places, line, color="#4f86c6", linewidth=0.6, alpha=0.6, zorder=1)
    means = [table[method].mean for method in methods]
    spreads = [table[method].spread for method in methods]
    ratio = METRICS[metric] == RATIO
    # Nothing is better than the best: bars end there.
    low = [min(spread, mean - ratio) for mean, spread in zip(means, spreads, strict=True)]
    bars = {"fmt": "o", "color": "#b3261e", "capsize": 5, "linewidth": 1.6, "zorder": 3}
    panel.errorbar(places, means, yerr=[low, spreads], **bars)
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    for place, mean in zip(places, means, strict=True):
        text = f"{mean:.3g}" if mean >= 0.01 else f"{mean:.4f}"
        panel.annotate(text, (place + 0.12, mean), fontsize=8, va="center", bbox=box, zorder=4)
    panel.set_xticks(list(places), methods, rotation=30, ha="right")
    panel.set_xlim(-0.4, len(methods) - 0.1)
    panel.grid(axis="y", color="#dddddd", linewidth=0.6, which="both")
    if ratio:
        _logarithmic(panel)
        panel.set_title(f"{metric}, lower is better (1: best of the still)", fontsize=10)
        panel.set_ylabel(f"{metric} / best {metric}, logarithmic")
    else:
        panel.invert_yaxis()
        unit = f" [{UNITS[metric].strip()}]" if UNITS[metric] else ""
        panel.set_title(f"{metric}, higher is better (0: best of the still)", fontsize=10)
        panel.set_ylabel(f"best {metric} - {metric}{unit}")


def _logarithmic(panel: Any) -> None:
    """Make the axis of values logarithmic, with plain numbers on it."""
    from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter

    panel.set_yscale("log")
    low, high = panel.get_ylim()
    steps = [1, 1.25, 1.5, 2, 3, 5, 7] if high < 10 else [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]
    panel.yaxis.set_major_locator(FixedLocator([step for step in steps if low <= step <= high]))
    panel.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_minor_formatter(NullFormatter())
