"""What a search found: table, Pareto front, picture, best configuration, and the search's run in MLflow."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from trainer.outputs import replacing, write_whole
from trainer.reports.front import on_front

FINISHED, STOPPED, FAILED, RUNNING = "finished", "stopped", "failed", "interrupted"


@dataclass(frozen=True)
class Trial:
    """One trial.

    Attributes:
        name: Its identity.
        values: Key of the configuration → value.
        score: Best value of the metric so far, NaN before the first validation.
        cost: Milliseconds per megapixel of the deployed network.
        epoch: Epochs that it was trained.
        state: `finished`, `stopped` (early, by ASHA), `failed` or `interrupted`.
        run: Folder of its run, empty where it has none.
        best: It is on the Pareto front.
    """

    name: str
    values: dict[str, Any]
    score: float = math.nan
    cost: float = math.nan
    epoch: int = 0
    state: str = RUNNING
    run: str = ""
    best: bool = False


def ranked(trials: Sequence[Trial], mode: str) -> list[Trial]:
    """Return trials, best score first, those of the Pareto front marked.

    The front is that of trained trials: one that was stopped early has no score that can be compared.

    Args:
        trials: All of them.
        mode: `max` or `min`.
    """
    sign = -1.0 if mode == "max" else 1.0

    trained = [t for t in trials if t.state == FINISHED and not math.isnan(t.score)]
    flags = on_front([(sign * trial.score, trial.cost) for trial in trained])
    best = {trial.name for trial, on in zip(trained, flags, strict=True) if on}
    marked = [replace(trial, best=trial.name in best) for trial in trials]
    order = {FINISHED: 0, STOPPED: 1, RUNNING: 2, FAILED: 3}
    return sorted(marked, key=lambda t: (order[t.state], math.isnan(t.score), sign * t.score, t.name))


def table(trials: Sequence[Trial], metric: str) -> str:
    """Return a table of trials as lines of text, the Pareto front with a star."""
    keys = sorted({key for trial in trials for key in trial.values})
    short = {key: _short(key, keys) for key in keys}
    head = ["", "trial", *(short[key] for key in keys), metric, "ms/Mpx", "epochs", "state"]
    rows = [
        [
            "*" if trial.best else "",
            trial.name,
            *(brief(trial.values.get(key, "")) for key in keys),
            "" if math.isnan(trial.score) else f"{trial.score:.4g}",
            "" if math.isnan(trial.cost) else f"{trial.cost:.0f}",
            str(trial.epoch),
            trial.state,
        ]
        for trial in trials
    ]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)
    ]
    return "\n".join(line.rstrip() for line in lines)


def _short(key: str, keys: Sequence[str]) -> str:
    """Return the end of a key that tells it from the others."""
    parts = [part for part in key.split(".") if part != "init_args"]
    for count in range(1, len(parts)):
        end = ".".join(parts[-count:])
        others = (
            ".".join([p for p in other.split(".") if p != "init_args"][-count:])
            for other in keys
            if other != key
        )
        if end not in others:
            return end
    return key


def brief(value: Any) -> str:
    """Return a value of a configuration for a table."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_results(folder: Path, trials: Sequence[Trial], metric: str, mode: str) -> list[Path]:
    """Write `trials.json`, `trials.txt`, `pareto.png` and `best.yaml`; returns what was written.

    Args:
        folder: Of the search.
        trials: In the order of `ranked`.
        metric: What was searched for.
        mode: `max` or `min`.
    """
    found = {"metric": metric, "mode": mode, "trials": [asdict(trial) for trial in trials]}
    written = [folder / "trials.json", folder / "trials.txt"]
    write_whole(written[0], json.dumps(found, indent=1) + "\n")
    write_whole(written[1], table(trials, metric) + "\n")
    if any(not math.isnan(trial.score) for trial in trials):
        written.append(folder / "pareto.png")
        with replacing(written[-1]) as partial:
            draw(partial, trials, metric)
    best = next((trial for trial in trials if trial.best), None)
    if best is not None and (Path(best.run) / "config.yaml").is_file():
        written.append(folder / "best.yaml")
        write_whole(written[-1], (Path(best.run) / "config.yaml").read_text())
    return written


def draw(path: Path, trials: Sequence[Trial], metric: str) -> None:
    """Draw score over cost; the Pareto front is a line, trials that were stopped early are hollow."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    groups = {
        "trained": [t for t in trials if t.state == FINISHED],
        "stopped early": [t for t in trials if t.state != FINISHED],
    }
    for (name, group), fill in zip(groups.items(), ("tab:blue", "none"), strict=True):
        if group:
            axes.scatter(
                [t.cost for t in group],
                [t.score for t in group],
                facecolor=fill,
                edgecolor="tab:blue",
                label=name,
            )
    front = sorted((t for t in trials if t.best), key=lambda t: t.cost)
    axes.plot(
        [t.cost for t in front], [t.score for t in front], color="tab:orange", label="Pareto front", zorder=0
    )
    for trial in front:
        axes.annotate(
            trial.name, (trial.cost, trial.score), fontsize=8, xytext=(4, 4), textcoords="offset points"
        )
    axes.set_xlabel("cost of the deployed network, ms per megapixel")
    axes.set_ylabel(metric)
    axes.legend()
    figure.savefig(path, dpi=120)
