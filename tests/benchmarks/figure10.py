"""Figure 10 of NFOR: how far each method is from the best one, per metric, over all stills.

A thin line is one still at one number of samples per pixel; dots are means, bars one standard deviation on
either side. MSE and relMSE are given as multiples of the best method's value (logarithmic axis), PSNR and
SSIM as differences from it, so that the best is at 1 or at 0.
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
    """Return the distances of methods to the best of them in each still that has all of them."""
    higher = METRICS[metric] == DIFFERENCE
    values = [{method: scores[method][metric] for method in methods if method in scores} for scores in stills]
    return Panel(metric, higher, UNITS[metric].strip(), distances(values, methods, higher))


def summary(stills: Sequence[Scores], metric: str, methods: Sequence[str]) -> dict[str, Distance]:
    """Return method → mean and standard deviation of its distances."""
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


def draw(blocks: Mapping[str, Sequence[Scores]], methods: Sequence[str], path: Path) -> None:
    """Draw one row of panels per block (title → stills) into a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = distance_figure(
        {title: [panel(stills, metric, methods) for metric in METRICS] for title, stills in blocks.items()}
    )
    figure.savefig(path, dpi=110)
