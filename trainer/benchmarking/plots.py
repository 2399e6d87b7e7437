"""Plots of figures as SVG files that stand for themselves."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from trainer.benchmarking.cases import Outcome
from trainer.benchmarking.table import bytes_text, name_of, seconds_text, shared_text, varied

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
"""Of Okabe and Ito, which people who see fewer colours can tell apart."""

_WIDTH, _ROW, _TOP = 760, 30, 46
_INK, _FAINT = "#222", "#ddd"


@dataclass(frozen=True)
class Quantity:
    """What a plot shows.

    Attributes:
        title: Its name.
        value: Of an outcome.
        low, high: Ends of its spread.
        text: A value in words.
    """

    title: str
    value: Callable[[Outcome], float]
    low: Callable[[Outcome], float]
    high: Callable[[Outcome], float]
    text: Callable[[float], str]


TIME = Quantity(
    "Time of a call (median and quartiles)",
    lambda o: o.median,
    lambda o: o.quartiles[0],
    lambda o: o.quartiles[1],
    seconds_text,
)
MEMORY_USE = Quantity(
    "Peak memory of a call",
    lambda o: float(o.peak_bytes),
    lambda o: float(o.peak_bytes),
    lambda o: float(o.peak_bytes),
    bytes_text,
)


def plot(outcomes: Sequence[Outcome], quantity: Quantity) -> str:
    """Return a drawing: lines over megapixels where there are several sizes, bars otherwise.

    Args:
        outcomes: Those without figures are left out; at least one has some.
        quantity: What is drawn.
    """
    done = [outcome for outcome in outcomes if outcome.done]
    columns = varied([outcome.case for outcome in done])
    title = f"{quantity.title}: {shared_text([o.case for o in done])}"
    if "size" in columns:
        return _lines(done, [name for name in columns if name != "size"], quantity, title)
    return _bars(done, columns, quantity, title)


def _document(width: int, height: int, title: str, parts: Sequence[Markup]) -> str:
    head = Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" width="{0}" height="{1}" viewBox="0 0 {0} {1}" '
        'font-family="sans-serif" font-size="13" fill="{2}" role="img">\n<title>{3}</title>\n'
        '<rect width="100%" height="100%" fill="#fff"/>\n<text x="12" y="24" font-weight="bold">{3}</text>\n'
    ).format(width, height, _INK, title)
    return str(head + Markup("\n").join(parts) + Markup("\n</svg>\n"))


def _text(x: float, y: float, text: str, anchor: str = "start") -> Markup:
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(x, y, anchor, text)


def _line(points: tuple[float, float, float, float], color: str, width: float = 1) -> Markup:
    return Markup(
        '<line x1="{:.1f}" y1="{:.1f}" x2="{:.1f}" y2="{:.1f}" stroke="{}" stroke-width="{}"/>'
    ).format(*points, color, width)


def _bars(done: Sequence[Outcome], columns: Sequence[str], quantity: Quantity, title: str) -> str:
    names = [_short(name_of(outcome.case, columns)) for outcome in done]
    left = min(20 + max(map(len, names)) * 7, 330)
    room = _WIDTH - left - 110
    longest = max(quantity.high(outcome) for outcome in done) or 1.0
    models = list(dict.fromkeys(outcome.case.method.label for outcome in done))
    parts: list[Markup] = []
    for number, (name, outcome) in enumerate(zip(names, done, strict=True)):
        y = _TOP + number * _ROW
        color = COLORS[models.index(outcome.case.method.label) % len(COLORS)]
        length, low, high = (
            room * f(outcome) / longest for f in (quantity.value, quantity.low, quantity.high)
        )
        bar = Markup('<rect x="{}" y="{}" width="{:.1f}" height="18" fill="{}" fill-opacity="0.8"/>')
        parts += [_text(left - 8, y + 14, name, "end"), bar.format(left, y, length, color)]
        if high > low:
            parts.append(_line((left + low, y + 9, left + high, y + 9), _INK))
            parts += [_line((left + x, y + 4, left + x, y + 14), _INK) for x in (low, high)]
        parts.append(_text(left + max(length, high) + 8, y + 14, quantity.text(quantity.value(outcome))))
    return _document(_WIDTH, _TOP + len(done) * _ROW + 10, title, parts)


def _round(text: str) -> str:
    """Return a round value without the zeros after its point."""
    return re.sub(r"\.0+ ", " ", text)


def _short(name: str, most: int = 44) -> str:
    return name if len(name) <= most else "…" + name[1 - most :]


def _lines(done: Sequence[Outcome], columns: Sequence[str], quantity: Quantity, title: str) -> str:
    series: dict[str, list[Outcome]] = {}
    for outcome in done:
        series.setdefault(name_of(outcome.case, columns), []).append(outcome)
    left, right, height = 80, _WIDTH - 30, 360
    bottom = _TOP + height
    pixels = [outcome.megapixels for outcome in done]
    ends = [f(outcome) for outcome in done for f in (quantity.low, quantity.high)]
    x = _Scale(min(pixels), max(pixels), left, right)
    y = _Scale(min(v for v in ends if v > 0) if any(ends) else 1.0, max(ends) or 1.0, bottom, _TOP)
    parts: list[Markup] = []
    for value in sorted(set(pixels)):
        parts += [_line((x(value), _TOP, x(value), bottom), _FAINT)]
        parts.append(_text(x(value), bottom + 18, f"{value:.3g}", "middle"))
    for value in y.ticks():
        parts += [_line((left, y(value), right, y(value)), _FAINT)]
        parts.append(_text(left - 6, y(value) + 4, _round(quantity.text(value)), "end"))
    parts.append(_text((left + right) / 2, bottom + 38, "megapixels of a call", "middle"))
    for number, (name, members) in enumerate(series.items()):
        color = COLORS[number % len(COLORS)]
        parts += _series(sorted(members, key=lambda o: o.megapixels), quantity, color, x, y)
        parts += [
            _line((left, bottom + 60 + number * 20, left + 24, bottom + 60 + number * 20), color, 2.5),
            _text(left + 32, bottom + 64 + number * 20, _short(name, 90)),
        ]
    return _document(_WIDTH, bottom + 64 + len(series) * 20 + 8, title, parts)


class _Scale:
    """A logarithmic axis."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        margin = 1.08
        self.low, self.high = low / margin, high * margin
        self._start, self._end = start, end

    def __call__(self, value: float) -> float:
        share = math.log(max(value, self.low) / self.low) / math.log(self.high / self.low)
        return self._start + share * (self._end - self._start)

    def ticks(self) -> list[float]:
        """Return round values: 1, 2 and 5 of each decade, of many decades 1 only."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        factors = (1, 2, 5) if len(decades) <= 4 else (1,)
        found = [factor * 10.0**decade for decade in decades for factor in factors]
        return [value for value in found if self.low <= value <= self.high]


def _series(members: Sequence[Outcome], quantity: Quantity, color: str, x: _Scale, y: _Scale) -> list[Markup]:
    points = [(x(o.megapixels), y(quantity.value(o))) for o in members]
    path = "M" + "L".join(f"{px:.1f} {py:.1f}" for px, py in points)
    parts = [Markup('<path d="{}" fill="none" stroke="{}" stroke-width="2"/>').format(path, color)]
    for outcome, (px, py) in zip(members, points, strict=True):
        parts.append(_line((px, y(quantity.low(outcome)), px, y(quantity.high(outcome))), color))
        parts.append(Markup('<circle cx="{:.1f}" cy="{:.1f}" r="3.5" fill="{}"/>').format(px, py, color))
    return parts
