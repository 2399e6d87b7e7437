"""Figure 2 of the training-free methods: how NFOR's time and memory grow.

With the resolution at 7 features and window radius 9; with the window radius and with the number of features
at a quarter of a megapixel. Frames are made of the sample's stills (`tests.benchmarks.mosaic`); 10 features
are normal, albedo, depth and the specular albedo. Each frame runs in a process of its own on two threads,
the way of `tests.benchmarks.nfor`; memory is what the process takes beside the loaded package and the frame.

    python -m tests.benchmarks.nfor_growth [--picture FILE]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.nfor import FEATURES, measured
from tests.benchmarks.timing import Row, print_table, row

SIZES = {"0.25": (432, 576), "1": (864, 1152), "4": (1728, 2304)}
"""Megapixels → rows and columns."""

WINDOWS = (5, 9, 13)
FEATURE_SETS: Mapping[int, tuple[str, ...]] = {
    0: (),
    3: FEATURES[:1],
    7: FEATURES,
    10: (*FEATURES, "specular_albedo"),
}


class Cost(NamedTuple):
    """What a frame took: wall and processor seconds, bytes, and its number of pixels."""

    wall: float
    processor: float
    memory: float
    pixels: int


Growth = dict[str, dict[float, Cost]]
"""What grows → its values → cost."""


def growth() -> Growth:
    """Measure all frames."""
    small = SIZES["0.25"]
    return {
        "megapixels": {float(name): _cost(size) for name, size in SIZES.items()},
        "window radius": {float(window): _cost(small, window) for window in WINDOWS},
        "features": {float(n): _cost(small, 9, names) for n, names in FEATURE_SETS.items()},
    }


def _cost(size: tuple[int, int], window: int = 9, features: tuple[str, ...] = FEATURES) -> Cost:
    found = measured(size, window, features)
    memory = max(0, found["bytes"]["peak"] - found["bytes"]["loaded"])
    return Cost(found["wall"], found["processor"], memory, size[0] * size[1])


def rows_of(found: Growth) -> list[Row]:
    """Return the table of what was measured."""
    rows: list[Row] = []
    for what, costs in found.items():
        for value, cost in costs.items():
            name = f"NFOR, {what} {value:g}"
            rows += [
                row(f"{name}: time", cost.wall, "s"),
                row(f"{name}: processor time", cost.processor / cost.pixels * 1e6, "us/px"),
                row(f"{name}: memory", cost.memory / cost.pixels, "B/px"),
            ]
    memory = [cost.memory for cost in found["window radius"].values()]
    ratio = memory[-1] / memory[0]
    area = ((2 * WINDOWS[-1] + 1) / (2 * WINDOWS[0] + 1)) ** 2
    return [
        *rows,
        row("window radius 13 / 5: pixels of the window", area, "x"),
        row("window radius 13 / 5: memory, margins included", ratio, "x"),
    ]


def picture(found: Growth, path: Path) -> None:
    """Draw time and memory per pixel over each quantity."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(found), figsize=(10.5, 5.4), sharex="col", sharey="row", squeeze=False)
    labels = {"megapixels": "megapixels", "window radius": "window radius", "features": "scalar features"}
    drawn: tuple[list[float], list[float]] = ([], [])
    for column, (what, costs) in enumerate(found.items()):
        values = list(costs)
        time = [cost.processor / cost.pixels * 1e6 for cost in costs.values()]
        memory = [cost.memory / cost.pixels for cost in costs.values()]
        for line, numbers in enumerate((time, memory)):
            drawn[line].extend(numbers)
            panel = axes[line][column]
            panel.plot(values, numbers, marker="o", color=("tab:blue", "tab:orange")[line], clip_on=False)
            panel.grid(alpha=0.3)
            for value, number in zip(values, numbers, strict=True):
                panel.annotate(
                    f"{number:.0f}", (value, number), (0, 7), textcoords="offset points", ha="center"
                )
        if what == "megapixels":
            axes[0][column].set_xscale("log", base=4)
        axes[1][column].set_xticks(values, [f"{value:g}" for value in values], minor=False)
        axes[1][column].set_xlabel(labels[what])
    axes[0][0].set_ylabel("processor time,\nµs per pixel")
    axes[1][0].set_ylabel("bytes per pixel\nbeside the frame")
    for panels, numbers in zip(axes, drawn, strict=True):
        panels[0].set_ylim(0, 1.2 * max(numbers))
    figure.suptitle("NFOR, compiled kernels, two threads")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(target: Path | None = None) -> list[Row]:
    """Return the rows of figure 2, and draw them if a file is named."""
    found = growth()
    if target:
        picture(found, target)
    return rows_of(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path, help="draw time and memory over each quantity")
    print_table(run(parser.parse_args().picture))
