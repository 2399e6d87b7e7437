"""Figures for people: a table no wider than a page, with what differs between the cases as columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from trainer.benchmarking.cases import Case, Outcome
from trainer.benchmarking.pairing import Comparison

if TYPE_CHECKING:
    from rich.table import Table

WIDTH = 100
BUSY = 0.1
"""Share of the cores in use by other programs from which it is said."""


def seconds_text(seconds: float) -> str:
    """Return a time with three significant digits: 831 µs, 41.3 ms, 1.27 s."""
    units = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))
    unit, name = next((pair for pair in units if seconds >= pair[0] * 0.9995), units[-1])
    return f"{_three(seconds / unit)} {name}"


def spread_text(low: float, high: float) -> str:
    """Return an interval of times in the unit that the larger one has: 40.9–41.8 ms."""
    name = seconds_text(high).split()[1]
    unit = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}[name]
    return f"{_three(low / unit)}–{_three(high / unit)} {name}"


def bytes_text(number: float) -> str:
    """Return bytes with three significant digits: 12.4 MB, 1.27 GB."""
    unit, name = next(
        (pair for pair in ((1e9, "GB"), (1e6, "MB")) if number >= pair[0] * 0.9995), (1e3, "kB")
    )
    return f"{_three(number / unit)} {name}"


def _three(value: float) -> str:
    digits = 2 if value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f}"


def varied(cases: Sequence[Case]) -> list[str]:
    """Return the settings that are columns: the model, and what is not the same in all cases."""
    settings = [case.settings for case in cases]
    return [
        name for name in settings[0] if name == "model" or len({setting[name] for setting in settings}) > 1
    ]


def shared_text(cases: Sequence[Case]) -> str:
    """Return what all cases have in common, in words."""
    columns = varied(cases)
    settings = cases[0].settings | {"batch": f"batch {cases[0].batch}"}
    return ", ".join(value for name, value in settings.items() if name not in columns)


def name_of(case: Case, columns: Sequence[str]) -> str:
    """Return what tells a case from the others."""
    settings = case.settings | {"batch": f"batch {case.batch}"}
    return " ".join(settings[name] for name in columns)


def table(outcomes: Sequence[Outcome]) -> Table:
    """Return a row per case: median and quartiles of a call, time per megapixel, memory."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    columns = varied([outcome.case for outcome in outcomes])
    # Text, since a path may hold brackets, which are markup in a plain string.
    title = Text(shared_text([o.case for o in outcomes]), style="table.title")
    shown = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for name in columns:
        shown.add_column(name, overflow="fold")
    for name in ("time", "quartiles", "per MP", "memory", "per MP"):
        shown.add_column(name, justify="right", no_wrap=True)
    for outcome in outcomes:
        shown.add_row(*(Text(outcome.case.settings[name]) for name in columns), *_figures(outcome))
    return shown


def _figures(outcome: Outcome) -> list[str]:
    if not outcome.done:
        return ["failed", "", "", "", ""]
    return [
        seconds_text(outcome.median),
        spread_text(*outcome.quartiles),
        seconds_text(outcome.median / outcome.megapixels),
        bytes_text(outcome.peak_bytes),
        bytes_text(outcome.peak_bytes / outcome.megapixels),
    ]


def remarks(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what the table does not say: why cases failed, and where others used the processor."""
    columns = varied([outcome.case for outcome in outcomes])
    lines = [f"{name_of(o.case, columns)}: {o.reason}" for o in outcomes if not o.done]
    busy = [o for o in outcomes if o.done and o.others > BUSY]
    if busy:
        most = max(o.others for o in busy)
        lines.append(
            f"Other programs used up to {most:.0%} of the processor in {len(busy)} of {len(outcomes)} cases: "
            "times are too long and spread; measure again on an idle machine."
        )
    return lines


def comparison_lines(comparison: Comparison) -> list[str]:
    """Return what came of a comparison, in words; nothing where a side failed, which `remarks` tells."""
    one, other = comparison.names
    if not all(side.done for side in comparison.sides):
        return []
    if not comparison.done:
        return [f"{one}, {other}: stopped before three pairs of processes were measured"]
    (low, high), ratio = comparison.interval, comparison.ratio
    verdict = "no significant difference"
    if comparison.significant:
        verdict = f"{other} is significantly {'faster' if ratio < 1 else 'slower'}"
    lines = [
        f"{other} takes {ratio:.3f} times as long as {one} (95 % confidence {low:.3f} to {high:.3f}, "
        f"{len(comparison.ratios)} pairs of processes): {verdict}"
    ]
    memory = [side.peak_bytes for side in comparison.sides]
    if all(memory):
        lines.append(f"and {memory[1] / memory[0]:.3f} times the memory")
    return lines
