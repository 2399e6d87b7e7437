"""Tables of the training-free methods: means, distances to the best (figure 10 of NFOR), costs (table 2)."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tests.benchmarks import figure10
from tests.benchmarks.classical_kept import Entry
from tests.benchmarks.crops import Crop
from tests.benchmarks.timing import Row, row

INPUT = "input"


class Result(NamedTuple):
    """One still at one number of samples per pixel.

    Attributes:
        still: Scene and number of the frame.
        spp: Samples per pixel.
        pixels: Of the frame.
        entries: Method → what it did; a method without its buffers is not in it.
        reference: Its crop, where there are crops.
    """

    still: str
    spp: int
    pixels: int
    entries: dict[str, Entry]
    reference: Crop | None = None


def complete(results: Sequence[Result], methods: Sequence[str]) -> list[Result]:
    """Return the stills that have all of these methods."""
    return [result for result in results if set(methods) <= set(result.entries)]


def means(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return method → metric → mean over the stills that have the method, and their number as `stills`."""
    found: dict[str, list[dict[str, float]]] = {}
    for result in results:
        for name, entry in result.entries.items():
            found.setdefault(name, []).append(entry.scores)
    return {
        name: {
            "stills": float(len(listed)),
            **{metric: statistics.fmean(values[metric] for values in listed) for metric in listed[0]},
        }
        for name, listed in found.items()
    }


def costs(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return method → mean processor time, mean memory, and both per megapixel of the stills it has."""
    found: dict[str, list[tuple[Entry, int]]] = {}
    for result in results:
        for name, entry in result.entries.items():
            if name != INPUT:
                found.setdefault(name, []).append((entry, result.pixels))
    table = {}
    for name, listed in found.items():
        pixels = sum(count for _, count in listed)
        seconds, size = (sum(getattr(entry, what) for entry, _ in listed) for what in ("seconds", "bytes"))
        table[name] = {
            "stills": float(len(listed)),
            "seconds": seconds / len(listed),
            "MB": size / len(listed) / 1e6,
            "s per MP": seconds / pixels * 1e6,
            "MB per MP": size / pixels,
        }
    return table


def report(block: str, results: Sequence[Result], compared: Sequence[str], ours: Sequence[str]) -> None:
    """Print means, distances to the best, whether one of `ours` leads, and costs.

    Where a method lacks stills everything is printed twice: over the stills that each method has, and over
    those that all have.
    """
    every = {name for result in results for name in result.entries}
    for name in set(compared) - every:
        print(f"{block}: {name} left out, since no still has its buffers")
    known = [name for name in compared if name in every]
    common = complete(results, sorted(every))
    _report(f"{block}, all stills", results, known, ours)
    if 0 < len(common) < len(results):
        _report(f"{block}, stills with all methods", common, known, ours)


def _report(title: str, results: Sequence[Result], compared: Sequence[str], ours: Sequence[str]) -> None:
    for spp in sorted({result.spp for result in results}):
        _print(f"{title}, {spp} samples per pixel: means", means([r for r in results if r.spp == spp]))
    listed = scores_of(results)
    kinds = [f"{metric}, {kind}" for metric, kind in figure10.METRICS.items()]
    print(f"\n{title}: distance to the best of those a still has, mean and standard deviation")
    print(f"{'':18}{'stills':>8}" + "".join(f"{kind:>26}" for kind in kinds))
    tables = [figure10.summary(listed, metric, compared) for metric in figure10.METRICS]
    for name in compared:
        count = sum(name in scores for scores in listed)
        print(
            f"{name:18}{count:>8}" + "".join(f"{t[name].mean:>17.3f} ±{t[name].spread:>7.3f}" for t in tables)
        )
    mine = [name for name in ours if name in compared]
    if 0 < len(mine) < len(compared):
        for metric in figure10.METRICS:
            print(figure10.verdict(listed, metric, compared, mine))
    _print(f"{title}: mean processor time and growth of memory (table 2)", costs(results))


def scores_of(results: Sequence[Result]) -> list[dict[str, dict[str, float]]]:
    """Return method → metric → value for each still."""
    return [{name: entry.scores for name, entry in result.entries.items()} for result in results]


def _print(title: str, table: Mapping[str, Mapping[str, float]]) -> None:
    if not table:
        return
    print(f"\n{title}")
    print(f"{'':18}" + "".join(f"{head:>11}" for head in next(iter(table.values()))))
    for name, values in table.items():
        print(f"{name:18}" + "".join(f"{value:>11.4g}" for value in values.values()))


def rows_of(block: str, results: Sequence[Result], compared: Sequence[str], ours: Sequence[str]) -> list[Row]:
    """Return the means, and our distances beside the least of the others.

    Only methods that all stills have are set beside each other; the means of others say over how many.
    """
    rows = []
    for spp in sorted({result.spp for result in results}):
        chosen = [result for result in results if result.spp == spp]
        for name, values in means(chosen).items():
            number = int(values["stills"])
            some = f" ({number} of {len(chosen)} stills)" if number < len(chosen) else ""
            shown = {"relMSE": "", "PSNR": "dB", "SSIM": ""}
            rows += [row(f"{block}, {spp} spp, {name}: {m}{some}", values[m], u) for m, u in shown.items()]
    listed = scores_of(results)
    everywhere = [name for name in compared if all(name in scores for scores in listed)]
    for metric in figure10.METRICS:
        table = figure10.summary(listed, metric, everywhere)
        others = [entry for name, entry in table.items() if name not in ours]
        for mine in (name for name in ours if name in everywhere):
            for what in figure10.Distance._fields if others else ():
                least = min(getattr(entry, what) for entry in others)
                ratio = _ratio(getattr(table[mine], what), least)
                name = f"{block}, {metric}: {what} of {mine}'s distance / least of the others"
                rows.append(row(name, ratio, "", "<= 1", ratio <= 1))
    return rows


def _ratio(value: float, least: float) -> float:
    """Return the quotient; distances are 0 where one method is the best on every still."""
    return value / least if least else (1.0 if value == 0 else math.inf)
