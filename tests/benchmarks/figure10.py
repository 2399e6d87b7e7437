"""Figure 10 of NFOR: how far each method is from the best one, per metric, over all stills.

A thin line is one still at one number of samples per pixel; dots are means, bars one standard deviation on
either side. MSE and relMSE are given as multiples of the best method's value (logarithmic axis), PSNR and
SSIM as differences from it, so that the best is at 1 or at 0. A still that lacks a method is compared without
it, and does not count for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from trainer.evaluation.distances import Distance, Panel, distances
from trainer.evaluation.plots import distance_figure

Scores = Mapping[str, Mapping[str, float]]
"""Method → metric → value, of one still."""

RATIO, DIFFERENCE = "times the best", "below the best"
METRICS = {"MSE": RATIO, "relMSE": RATIO, "PSNR": DIFFERENCE, "SSIM": DIFFERENCE}
UNITS = {"MSE": "", "relMSE": "", "PSNR": " dB", "SSIM": ""}


def panel(stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> Panel:
    """Return the distances of methods to the best of those that a still has, still by still."""
    higher = METRICS[metric] == DIFFERENCE
    found: dict[str, list[float]] = {method: [] for method in methods}
    for scores in stills:
        values = {name: scores[name][metric] for name in methods if name in scores}
        for name, apart in distances([values], list(values), higher).items():
            found[name] += apart
    return Panel(metric, higher, UNITS[metric].strip(), found)


def summary(stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> dict[str, Distance]:
    """Return method → mean and standard deviation of its distances, over the stills that it has."""
    found = panel(stills, metric, methods).values
    return {method: Distance.of(values) for method, values in found.items()}


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


def drawn(blocks: Mapping[str, Sequence[Scores]], methods: Sequence[str]) -> dict[str, list[Panel]]:
    """Return the rows of panels: of each block the methods that all stills have, on all stills.

    Where some stills lack a method there is a second row, of all methods on the stills that have them all.
    """
    rows = {}
    for title, stills in blocks.items():
        every = [name for name in methods if any(name in scores for scores in stills)]
        always = [name for name in every if all(name in scores for scores in stills)]
        common = [scores for scores in stills if set(every) <= set(scores)]
        rows[title] = [panel(stills, metric, always) for metric in METRICS]
        if len(always) < len(every) and common:
            rows[f"{title}, where all methods have their buffers"] = [
                panel(common, metric, every) for metric in METRICS
            ]
    return rows


def draw(blocks: Mapping[str, Sequence[Scores]], methods: Sequence[str], path: Path) -> None:
    """Draw the rows of panels (`drawn`) of blocks (title → stills) into a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    distance_figure(drawn(blocks, methods)).savefig(path, dpi=110)
