"""Swept shapes: tubes along curves, lathes, shells, chains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.render.spec import Mesh
from data.render.surfaces import affine, grid_mesh, joined, outward, rotation, transformed, unit

Floats = NDArray[np.float64]
Rng = np.random.Generator


def section(rng: Rng, count: int = 20) -> Floats:
    """Return a closed outline (count + 1, 2) of radius about 1: circle, ellipse, star, rounded square."""
    t = np.linspace(0, 2 * np.pi, count + 1)
    kind = rng.integers(4)
    if kind == 0:
        return np.stack([np.cos(t), np.sin(t)], 1)
    if kind == 1:
        return np.stack([np.cos(t), rng.uniform(0.3, 0.7) * np.sin(t)], 1)
    if kind == 2:
        radius = 1 + rng.uniform(0.1, 0.3) * np.cos(rng.integers(3, 7) * t)
        return np.stack([radius * np.cos(t), radius * np.sin(t)], 1)
    power = rng.uniform(0.3, 0.7)
    c, s = np.cos(t).round(9), np.sin(t).round(9)
    return np.stack([np.sign(c) * np.abs(c) ** power, np.sign(s) * np.abs(s) ** power], 1)


def _frames(curve: Floats, closed: bool) -> tuple[Floats, Floats]:
    """Return two normals (N, 3) along a curve, carried without twist; closed curves end as they began."""
    if closed:
        tangent = np.roll(curve[:-1], -1, 0) - np.roll(curve[:-1], 1, 0)
        tangent = unit(np.concatenate([tangent, tangent[:1]]))
    else:
        tangent = unit(np.gradient(curve, axis=0))
    start = np.eye(3)[np.abs(tangent[0]).argmin()]
    first = np.empty_like(curve)
    first[0] = unit(start - (start @ tangent[0]) * tangent[0])
    for i in range(1, len(curve)):
        carried = first[i - 1] - (first[i - 1] @ tangent[i]) * tangent[i]
        first[i] = unit(carried)
    second = np.cross(tangent, first)
    if closed:
        angle = np.arctan2(first[0] @ second[-1], first[0] @ first[-1])
        turn = np.linspace(0, 1, len(curve))[:, None] * angle
        first, second = (
            np.cos(turn) * first + np.sin(turn) * second,
            np.cos(turn) * second - np.sin(turn) * first,
        )
    return first, second


def tube(curve: Floats, radius: Floats, outline: Floats, closed: bool) -> Mesh:
    """Return an outline swept along a curve; open ends are closed by a point.

    Args:
        curve: Points (N, 3); a closed curve repeats its first point.
        radius: Radius at each point (N,).
        outline: Closed outline (K, 2), counter-clockwise.
        closed: The curve ends where it begins.
    """
    first, second = _frames(curve, closed)
    x, y = outline[:, 0], outline[:, 1]
    ring = x[None, :, None] * first[:, None, :] + y[None, :, None] * second[:, None, :]
    points = curve[:, None, :] + radius[:, None, None] * ring
    if not closed:
        ends = [np.repeat(curve[i][None, None], len(outline), 1) for i in (0, -1)]
        points = np.concatenate([ends[0], points, ends[1]])
    length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    around = 2 * np.pi * max(float(radius.mean()), 1e-3)
    return outward(grid_mesh(points, (1.0, max(1.0, round(length / around)))))


def torus(rng: Rng) -> Mesh:
    """Return a ring of random thickness and section."""
    t = np.linspace(0, 2 * np.pi, 65)
    squash = rng.uniform(0.6, 1.0)
    curve = np.stack([np.cos(t), 0 * t, squash * np.sin(t)], 1).round(9)
    return tube(curve, np.full(65, rng.uniform(0.12, 0.45) * squash), section(rng, 28), True)


def knot(rng: Rng) -> Mesh:
    """Return a torus knot or a random closed curve as a tube."""
    t = np.linspace(0, 2 * np.pi, 161)
    if rng.random() < 0.6:
        p, q = [(2, 3), (3, 2), (2, 5), (3, 4), (5, 2), (3, 5)][rng.integers(6)]
        r = 1 + 0.4 * np.cos(q * t)
        curve = np.stack([r * np.cos(p * t), 0.5 * np.sin(q * t), r * np.sin(p * t)], 1)
        width = rng.uniform(0.1, 0.2)
    else:
        amplitude = rng.normal(0, 1, (2, 3, 3)) / np.arange(1, 4)[None, :, None]
        phase = np.arange(1, 4)[:, None] * t
        curve = np.cos(phase).T @ amplitude[0] + np.sin(phase).T @ amplitude[1]
        curve /= np.abs(curve).max()
        width = rng.uniform(0.06, 0.14)
    curve[-1] = curve[0]
    radius = width * (1 + rng.uniform(0, 0.4) * np.cos(rng.integers(1, 12) * t))
    return tube(curve, radius, section(rng, 16), True)


def spring(rng: Rng) -> Mesh:
    """Return a helix as a tube, its radius varying along it."""
    turns = rng.integers(3, 8)
    t = np.linspace(0, 1, 32 * turns + 1)
    angle, r = 2 * np.pi * turns * t, 0.5 + rng.uniform(-0.3, 0.3) * (t - 0.5) * 2
    curve = np.stack([r * np.cos(angle), rng.uniform(0.8, 1.6) * (t - 0.5), r * np.sin(angle)], 1)
    return tube(curve, np.full(len(t), rng.uniform(0.03, 0.09)), section(rng, 12), False)


def worm(rng: Rng) -> Mesh:
    """Return a wandering tube with round ends."""
    t = np.linspace(0, 1, 97)
    knots = np.cumsum(rng.normal(0, 1, (7, 3)), 0)
    weights = np.exp(-((t[:, None] * 6 - np.arange(7)) ** 2) / 1.2)
    curve = (weights / weights.sum(1, keepdims=True)) @ knots
    curve /= np.ptp(curve, axis=0).max()
    profile = np.sqrt(np.maximum(1 - np.abs(2 * t - 1) ** rng.uniform(2, 12), 1e-4))
    bumps = 1 + rng.uniform(0, 0.3) * np.cos(2 * np.pi * rng.integers(2, 16) * t)
    return tube(curve, rng.uniform(0.06, 0.2) * profile * bumps, section(rng), False)


def shell(rng: Rng) -> Mesh:
    """Return a spiral shell whose tube grows as it turns."""
    turns = rng.uniform(2.5, 4)
    t = np.linspace(0, 1, 129)
    grow = np.exp(rng.uniform(1.8, 2.6) * (t - 1))
    angle = 2 * np.pi * turns * t
    lift = rng.uniform(0.2, 1.2) * (1 - grow)
    curve = np.stack([0.6 * grow * np.cos(angle), lift, 0.6 * grow * np.sin(angle)], 1)
    ridge = 1 + rng.uniform(0, 0.12) * np.cos(rng.integers(10, 40) * angle / 3)
    return tube(curve, 0.42 * grow * ridge, section(rng, 24), False)


def lathe(rng: Rng) -> Mesh:
    """Return a vase, bowl, bottle or goblet: a wall of some thickness turned about the Y axis."""
    count = int(rng.integers(5, 8))
    heights = np.linspace(0, 1, count)
    radii = np.clip(rng.normal(0.4, 0.18, count), 0.1, 0.8)
    t = np.linspace(0, 1, 41)
    weights = np.exp(-((t[:, None] - heights) ** 2) * (count - 1) ** 2 / 0.8)
    r = (weights / weights.sum(1, keepdims=True)) @ radii
    h = rng.uniform(0.5, 1.8) * t
    wall = rng.uniform(0.02, 0.06)
    outer = np.stack([np.concatenate([[0.0, r[0] - 0.01], r]), np.concatenate([[0.0, 0.0], h])], 1)
    inner_r, inner_h = np.maximum(r - wall, 0.02)[::-1], np.maximum(h, wall)[::-1]
    inner = np.stack([np.append(inner_r, 0.0), np.append(inner_h, wall)], 1)
    if rng.random() < 0.3:
        inner = np.array([[0.0, h[-1]]])
    profile = np.concatenate([outer, inner])
    angle = np.linspace(0, 2 * np.pi, 49)
    flutes = 1 + (
        rng.uniform(0.02, 0.1) * np.cos(rng.integers(5, 20) * angle) if rng.random() < 0.3 else 0 * angle
    )
    x = profile[:, :1] * (flutes * np.cos(angle))[None]
    z = profile[:, :1] * (flutes * np.sin(angle))[None]
    points = np.stack([x, np.repeat(profile[:, 1:], len(angle), 1), z], -1)
    return outward(grid_mesh(points, (4.0, 2.0)))


def chain(rng: Rng) -> Mesh:
    """Return a few links that hang in each other."""
    t = np.linspace(0, 2 * np.pi, 41)
    stretch, width = rng.uniform(1.2, 1.8), rng.uniform(0.12, 0.2)
    curve = np.stack([stretch * np.cos(t), np.sin(t), 0 * t], 1)
    link = tube(curve, np.full(41, width), section(rng, 14), True)
    links, at, direction = [], np.zeros(3), np.array([1.0, 0.0, 0.0])
    for i in range(int(rng.integers(3, 7))):
        turn = rotation(np.array([0, 1, 0]), float(np.arctan2(-direction[2], direction[0])))
        roll = rotation(np.array([1, 0, 0]), np.pi / 2 * (i % 2) + rng.uniform(-0.2, 0.2))
        links.append(transformed(link, affine(turn @ roll, at)))
        at = at + direction * 2 * (stretch - width)
        bend = rng.uniform(-0.4, 0.4)
        direction = rotation(np.array([0, 1, 0]), bend) @ direction
    return joined(links)
