"""Procedural textures: noise, cells, woven, laid and printed patterns in random palettes. Most tile."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data.render.noise import cell_noise, fbm
from data.render.spec import Picture

Floats = NDArray[np.float64]
Rng = np.random.Generator
Pattern = Callable[[Rng, int], Floats]
"""Generator, pixels per side → values (size, size) in [0, 1]."""

BRIGHTEST = 0.9
"""Largest reflectance: nothing real is whiter, and light in a room of white walls would never end."""


def random_colour(rng: Rng) -> Floats:
    """Return a linear reflectance (3,) in [0.02, 0.9]: vivid, pastel, earthy or grey."""
    hue, mood = rng.random(), rng.random()
    if mood < 0.4:
        saturation, value = rng.uniform(0.5, 0.95), rng.uniform(0.35, 1.0)
    elif mood < 0.65:
        saturation, value = rng.uniform(0.1, 0.5), rng.uniform(0.6, 1.0)
    elif mood < 0.85:
        hue, saturation, value = rng.uniform(0.02, 0.15), rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.85)
    else:
        saturation, value = 0.0, rng.uniform(0.15, 0.95)
    return np.clip(np.array(colorsys.hsv_to_rgb(hue, saturation, value)) ** 2.2, 0.02, BRIGHTEST)


def random_palette(rng: Rng) -> Floats:
    """Return two to five colours (K, 3): shades of one, two that alternate, or any."""
    count, kind = int(rng.integers(2, 6)), rng.random()
    first, second = random_colour(rng), random_colour(rng)
    if kind < 0.35:
        shade = rng.permutation(np.linspace(rng.uniform(0.15, 0.5), 1.0, count))
        return np.clip(first * shade[:, None] * rng.uniform(0.85, 1.15, (count, 3)), 0.02, BRIGHTEST)
    if kind < 0.7:
        t = rng.permutation(np.linspace(0, 1, count))[:, None]
        return first * (1 - t) + second * t
    return np.stack([random_colour(rng) for _ in range(count)])


def _smooth(rng: Rng, size: int) -> Floats:
    return 0.5 + 0.5 * fbm(rng, size, int(rng.integers(2, 9)), int(rng.integers(2, 7)), rng.uniform(0.4, 0.7))


def _ridged(rng: Rng, size: int) -> Floats:
    return 1 - np.abs(fbm(rng, size, int(rng.integers(2, 8)), 5)) ** rng.uniform(0.3, 1.0)


def _grain(rng: Rng, size: int) -> Floats:
    coarse = fbm(rng, size, 4, 3)
    return np.clip(0.5 + 0.25 * coarse + rng.uniform(0.1, 0.35) * rng.standard_normal((size, size)), 0, 1)


def _cells(rng: Rng, size: int) -> Floats:
    cells = cell_noise(rng, size, int(rng.integers(4, 20)))
    kind = rng.integers(3)
    if kind == 0:
        return np.clip(cells.nearest / 0.8, 0, 1)
    shade = rng.random(int(cells.label.max()) + 1)[cells.label]
    edge = np.clip((cells.second - cells.nearest) / rng.uniform(0.04, 0.2), 0, 1)
    return edge * (0.2 + 0.8 * shade) if kind == 1 else edge


def _coordinates(size: int) -> tuple[Floats, Floats]:
    axis = (np.arange(size) + 0.5) / size
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def _checker(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    a, b = rng.integers(1, 13, 2) * 2
    return (np.floor(x * a) + np.floor(y * b)) % 2


def _stripes(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    a, b = rng.integers(0, 24, 2)
    phase = (x * max(int(a), 1) + y * int(b) + rng.uniform(0, 0.3) * fbm(rng, size, 3, 3)) % 1
    if rng.random() < 0.5:
        return (phase < rng.uniform(0.2, 0.8)).astype(float)
    return 0.5 - 0.5 * np.cos(2 * np.pi * phase)


def _bricks(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    columns, rows = int(rng.integers(2, 9)), int(rng.integers(2, 9)) * 2
    row = np.floor(y * rows)
    column = x * columns + 0.5 * (row % 2) * (rng.random() < 0.8)
    shade = rng.random((rows, columns))[row.astype(int), np.floor(column).astype(int) % columns]
    gap = rng.uniform(0.02, 0.08)
    edge_x, edge_y = np.abs(column % 1 - 0.5), np.abs(y * rows % 1 - 0.5)
    brick = (edge_x < 0.5 - gap * columns / rows) & (edge_y < 0.5 - gap)
    return np.where(brick, 0.35 + 0.45 * shade + 0.15 * fbm(rng, size, 16, 3), 0.05)


def _tiles(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    count = int(rng.integers(2, 13))
    shade = rng.random((count, count)) * rng.uniform(0, 1)
    value = 1 - shade[np.floor(y * count).astype(int), np.floor(x * count).astype(int)]
    edge = np.maximum(np.abs(x * count % 1 - 0.5), np.abs(y * count % 1 - 0.5))
    return np.where(edge < 0.5 - rng.uniform(0.01, 0.05), value, 0.0)


def _wood(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    rings = int(rng.integers(4, 16))
    phase = rings * x + rng.uniform(0.5, 2.0) * fbm(rng, size, 2, 3) + 0.3 * np.sin(2 * np.pi * y)
    fibre = fbm(rng, size, 32, 3)[:, :: max(1, size // 128)]
    fibre = np.repeat(fibre, -(-size // fibre.shape[1]), 1)[:, :size].T
    return np.clip(0.5 + 0.35 * (2 * (phase % 1) - 1) + 0.25 * fibre, 0, 1)


def _marble(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    a, b = rng.integers(1, 6, 2)
    warp = rng.uniform(0.4, 1.2) * fbm(rng, size, 3, 6, 0.55)
    return np.abs(np.sin(np.pi * (a * x + b * y) + 4 * warp)) ** rng.uniform(0.3, 1.0)


def _dots(rng: Rng, size: int) -> Floats:
    cells = cell_noise(rng, size, int(rng.integers(4, 24)), 0.0 if rng.random() < 0.5 else 0.7)
    radius = rng.uniform(0.15, 0.42)
    shade = rng.uniform(0.4, 1.0, int(cells.label.max()) + 1)[cells.label]
    return np.clip((radius - cells.nearest) / 0.04, 0, 1) * shade


def _scratches(rng: Rng, size: int) -> Floats:
    value = 0.3 + 0.2 * fbm(rng, size, 4, 4)
    count, steps = int(rng.integers(40, 250)), np.arange(size)
    angle = rng.normal(rng.uniform(0, np.pi), rng.choice([0.1, 2.0]), count)
    start, length = rng.random((count, 2)) * size, rng.integers(size // 8, size // 2, count)
    for k in range(count):
        along = steps[: length[k]]
        x = (start[k, 0] + along * np.cos(angle[k])).astype(int) % size
        y = (start[k, 1] + along * np.sin(angle[k])).astype(int) % size
        value[y, x] = rng.uniform(0.5, 1.0)
    return np.clip(value, 0, 1)


def _weave(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    threads = int(rng.integers(6, size // 6)) * 2
    u, v = x * threads, y * threads
    over = (np.floor(u) + np.floor(v)) % 2 < 1
    profile = np.where(over, np.abs(np.sin(np.pi * u)), np.abs(np.sin(np.pi * v)))
    return np.clip(0.15 + profile * np.where(over, 0.8, 0.5), 0, 1)


def _gradient(rng: Rng, size: int) -> Floats:
    x, y = _coordinates(size)
    kind = rng.integers(3)
    if kind == 0:
        return np.abs(2 * y - 1)
    if kind == 1:
        return np.clip(1 - 2 * np.hypot(x - 0.5, y - 0.5), 0, 1)
    return 0.5 + 0.25 * (np.cos(2 * np.pi * x) + np.sin(2 * np.pi * y))


def _maze(rng: Rng, size: int) -> Floats:
    count = 1 << int(rng.integers(3, 6))
    x, y = _coordinates(size)
    u, v = x * count, y * count
    flip = rng.random((count, count))[v.astype(int), u.astype(int)] < 0.5
    u = np.where(flip, 1 - u % 1, u % 1)
    arcs = np.minimum(np.abs(np.hypot(u, v % 1) - 0.5), np.abs(np.hypot(1 - u, 1 - v % 1) - 0.5))
    return np.clip((rng.uniform(0.08, 0.25) - arcs) / 0.05, 0, 1)


PATTERNS: dict[str, Pattern] = {
    "smooth": _smooth,
    "ridged": _ridged,
    "grain": _grain,
    "cells": _cells,
    "checker": _checker,
    "stripes": _stripes,
    "bricks": _bricks,
    "tiles": _tiles,
    "wood": _wood,
    "marble": _marble,
    "dots": _dots,
    "scratches": _scratches,
    "weave": _weave,
    "gradient": _gradient,
    "maze": _maze,
}
"""Name → pattern, 15 of them."""


def random_pattern(rng: Rng, kind: str | None = None) -> Floats:
    """Return values (size, size) in [0, 1] of a pattern of 128 to 512 pixels per side."""
    name = kind or list(PATTERNS)[int(rng.integers(len(PATTERNS)))]
    size = int(rng.choice([128, 256, 256, 512]))
    return np.clip(PATTERNS[name](rng, size), 0, 1)


def muted(colours: Floats, vividness: float) -> Floats:
    """Return colours (..., 3) drawn towards their grey; 1 keeps them, 0 leaves grey."""
    grey = colours.mean(-1, keepdims=True)
    return grey + vividness * (colours - grey)


def random_texture(rng: Rng, kind: str | None = None, vividness: float = 1.0) -> Picture:
    """Return a colour texture (size, size, 3), linear, within [0.02, 0.9].

    Args:
        rng: Source of all choices.
        kind: A name of `PATTERNS`; None: any.
        vividness: Saturation of the palette, 1: as drawn.
    """
    value = random_pattern(rng, kind)
    palette = muted(random_palette(rng), vividness)
    stops = np.linspace(0, 1, len(palette))
    if rng.random() < 0.25:
        number = np.minimum((value * len(palette)).astype(int), len(palette) - 1)
        pixels = palette[number]
    else:
        pixels = np.stack([np.interp(value, stops, palette[:, k]) for k in range(3)], -1)
    if rng.random() < 0.4:
        pixels = pixels * (1 + rng.uniform(0.05, 0.25) * fbm(rng, len(value), 6, 5))[..., None]
    return Picture(np.clip(pixels, 0.02, BRIGHTEST).astype(np.float32))


def random_weights(rng: Rng, low: float, high: float) -> Picture:
    """Return a picture of numbers (size, size, 1) that run over [low, high], for roughness."""
    value = random_pattern(rng)
    spread = max(float(np.ptp(value)), 1e-6)
    return Picture(
        (low + (high - low) * (value - value.min()) / spread)[..., None].astype(np.float32), raw=True
    )
