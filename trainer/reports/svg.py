"""Inline SVG drawings and numbers of the data report; colours come from the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from data.statistics import Histogram, Scale
from trainer.reports.pictures import colors

_WIDTH, _HEIGHT = 360, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 8, 8, 8, 24


def histogram_svg(series: Mapping[str, Histogram], label: str) -> Markup:
    """Return one drawing of histograms that share their bins; the first is filled, others are lines.

    Args:
        series: Name → histogram; each is drawn as shares of its own values.
        label: What is counted, for readers that do not see it.
    """
    shown = {name: h for name, h in series.items() if h.total}
    if not shown:
        return Markup("")
    scale = next(iter(shown.values())).scale
    first, last = _range(shown)
    highest = max(float(h.counts.max()) / h.total for h in shown.values()) or 1.0
    parts = [Markup('<svg class="plot" viewBox="0 0 {} {}" role="img" aria-label="{}">').format(
        _WIDTH, _HEIGHT, label
    )]  # fmt: skip
    parts.append(_axis(scale, first, last))
    for number, h in enumerate(shown.values()):
        shares = h.counts[first:last] / h.total / highest
        if not scale.logarithmic:
            # Most albedos and lengths are 0 or 1; the root shows the others beside these peaks.
            shares = shares**0.5
        path = _steps(shares.tolist(), closed=number == 0)
        parts.append(Markup('<path class="series s{}" d="{}"/>').format(number, path))
    return Markup("").join([*parts, Markup("</svg>")])


def outside_text(histogram: Histogram) -> str:
    """Return what a histogram does not show: shares of zeros and of values beyond its bins."""
    counted = (
        (histogram.zero, "are 0"),
        (histogram.below, "below the axis"),
        (histogram.above, "above the axis"),
    )
    found = [f"{percent(n / histogram.total)} {text}" for n, text in counted if n]
    return ", ".join(found)


def percent(share: float) -> str:
    """Return a share as percent with two significant digits: 0 %, < 0.001 %, 0.012 %, 3.4 %, 57 %."""
    value = 100 * share
    if 0 < value < 0.001:
        return "< 0.001 %"
    if value == 0 or abs(value) >= 9.95:
        return f"{value:.0f} %"
    return f"{value:.1f} %" if abs(value) >= 0.95 else f"{value:.2g} %"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, – where there is none."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.{digits}g}".replace("-", "−", 1) if value < 0 else f"{value:.{digits}g}"


def fixed(value: float | None, digits: int) -> str:
    """Return a number with so many decimals, – where there is none."""
    if value is None or not math.isfinite(value):
        return number(value)
    return f"{value:.{digits}f}".replace("-", "−")


def split_svg(counts: Mapping[str, int]) -> Markup:
    """Return a bar whose parts are as wide as their numbers."""
    total = sum(counts.values())
    parts, x = [Markup('<svg class="bar" viewBox="0 0 1000 24" preserveAspectRatio="none" role="img">')], 0.0
    for name, count in counts.items():
        width = 1000 * count / total if total else 0
        parts.append(
            Markup('<rect class="{}" x="{:.1f}" width="{:.1f}" height="24"/>').format(
                f"fill-{name}", x, max(0, width - 2)
            )
        )
        x += width
    return Markup("").join([*parts, Markup("</svg>")])


def heat_css() -> str:
    """Return the colours of the density maps as a CSS gradient."""
    chosen = colors()[np.linspace(40, 255, 12).astype(int)]
    return "linear-gradient(90deg, " + ", ".join(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in chosen) + ")"


def _range(shown: Mapping[str, Histogram]) -> tuple[int, int]:
    """Return the bins to draw: all of a linear scale, whole decades with values of a logarithmic one."""
    scale = next(iter(shown.values())).scale
    if not scale.logarithmic:
        return 0, scale.bins
    # A bin with fewer than one value in ten thousand would be invisible, and squeeze the others.
    used = [i for h in shown.values() for i, n in enumerate(h.counts.tolist()) if n > h.total * 1e-4]
    decade = round(scale.bins / (scale.high - scale.low))
    if not used:
        return 0, scale.bins
    first, last = min(used) // decade * decade, -(-(max(used) + 1) // decade) * decade
    return max(0, first), min(scale.bins, last)


def _axis(scale: Scale, first: int, last: int) -> Markup:
    width = (scale.high - scale.low) / scale.bins
    low, high = scale.low + first * width, scale.low + last * width
    base = _HEIGHT - _BOTTOM
    parts = [
        Markup('<line class="axis" x1="{}" x2="{}" y1="{}" y2="{}"/>').format(
            _LEFT, _WIDTH - _RIGHT, base, base
        )
    ]
    ticks = range(round(low), round(high) + 1) if scale.logarithmic else [low + i * 0.2 for i in range(9)]
    for tick in ticks:
        if tick > high + 1e-9:
            continue
        x = _LEFT + (tick - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)
        anchor = "start" if x < 20 else "end" if x > _WIDTH - 20 else "middle"
        parts.append(
            Markup('<line class="tick" x1="{0:.1f}" x2="{0:.1f}" y1="{1}" y2="{2}"/>').format(x, _TOP, base)
        )
        text = _power(int(tick)) if scale.logarithmic else f"{tick:.1f}"
        parts.append(
            Markup('<text x="{:.1f}" y="{}" text-anchor="{}">{}</text>').format(x, _HEIGHT - 7, anchor, text)
        )
    return Markup("").join(parts)


def _power(exponent: int) -> str:
    return f"{10.0**exponent:g}" if -3 <= exponent <= 4 else f"1e{exponent}"


def _steps(shares: list[float], *, closed: bool) -> str:
    """Return the outline of bars; heights are shares of the highest."""
    base, height = _HEIGHT - _BOTTOM, _HEIGHT - _BOTTOM - _TOP
    step = (_WIDTH - _LEFT - _RIGHT) / len(shares)
    points = [f"M{_LEFT} {base}"]
    for i, share in enumerate(shares):
        y = base - share * height
        points.append(f"V{y:.1f}H{_LEFT + (i + 1) * step:.1f}")
    return "".join([*points, f"V{base}", "Z" if closed else ""])
