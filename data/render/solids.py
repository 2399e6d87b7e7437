"""Solids made face by face: superquadrics, lumps, prisms, gears, rocks, fragments, towers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from data.render.implicit import random_turn
from data.render.noise import SpaceNoise
from data.render.spec import Mesh
from data.render.surfaces import (
    box_uvs,
    build,
    flat,
    grid_faces,
    grid_mesh,
    outward,
    unit,
)

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]
Rng = np.random.Generator


def sphere_points(rows: int, columns: int) -> Floats:
    """Return the unit sphere as a grid (rows, columns, 3) from the south to the north pole, front outside."""
    v, u = np.meshgrid(
        np.linspace(-0.5, 0.5, rows) * np.pi, np.linspace(0, 2 * np.pi, columns), indexing="ij"
    )
    return np.stack([np.cos(v) * np.cos(u), np.sin(v), np.cos(v) * np.sin(u)], -1)


@lru_cache(maxsize=4)
def icosphere(level: int) -> tuple[Floats, Faces]:
    """Return vertices on the unit sphere and faces: an icosahedron divided `level` times."""
    g = (1 + 5**0.5) / 2
    corners = [(s * 1.0, t * g, 0.0) for s in (-1, 1) for t in (-1, 1)]
    vertices = unit(np.array([np.roll(c, k) for k in range(3) for c in corners]))
    gram = vertices @ vertices.T
    near = gram > 0.44
    triples = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    faces = np.array(triples)
    turned = (
        np.einsum("ij,ij->i", np.cross(vertices[faces[:, 0]], vertices[faces[:, 1]]), vertices[faces[:, 2]])
        < 0
    )
    faces[turned] = faces[turned][:, ::-1]
    for _ in range(level):
        vertices, faces = divided(vertices, faces)
        vertices = unit(vertices)
    return vertices, faces


def divided(vertices: Floats, faces: Faces) -> tuple[Floats, Faces]:
    """Return every face cut into four at the middles of its edges."""
    a, b, c = faces.T
    edges = np.sort(np.concatenate([np.stack(e, 1) for e in ((a, b), (b, c), (c, a))]), 1)
    unique, number = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
    ab, bc, ca = (number.reshape(-1) + len(vertices)).reshape(3, -1)
    middle = (vertices[unique // len(vertices)] + vertices[unique % len(vertices)]) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([vertices, middle]), np.concatenate([np.stack(p, 1) for p in parts])


def superquadric(rng: Rng) -> Mesh:
    """Return a superellipsoid of random exponents and axes."""
    points = sphere_points(45, 65)
    e1, e2 = np.exp(rng.uniform(np.log(0.25), np.log(2.2), 2))
    v, u = np.meshgrid(np.linspace(-0.5, 0.5, 45) * np.pi, np.linspace(0, 2 * np.pi, 65), indexing="ij")

    def power(x: Floats, e: float) -> Floats:
        return np.sign(x) * np.abs(x) ** e

    points[..., 0] = power(np.cos(v), e1) * power(np.cos(u), e2)
    points[..., 1] = power(np.sin(v), e1)
    points[..., 2] = power(np.cos(v), e1) * power(np.sin(u), e2)
    points[:, -1] = points[:, 0]
    points[[0, -1]] *= np.array([0.0, 1.0, 0.0])
    return outward(grid_mesh(points * rng.uniform(0.4, 1.0, 3), (4.0, 2.0)))


def displaced_sphere(rng: Rng) -> Mesh:
    """Return a ball with noise on it: lumps, folds or spikes."""
    vertices, faces = icosphere(4)
    noise, kind = SpaceNoise(rng), rng.integers(3)
    value = noise.fbm(vertices * rng.uniform(1.0, 4.0) + 8, int(rng.integers(1, 5)))
    if kind == 1:
        value = -np.abs(value) * 1.5
    elif kind == 2:
        value = np.maximum(value, 0) ** 2 * 3
    vertices = vertices * (1 + rng.uniform(0.2, 0.6) * value)[:, None] * rng.uniform(0.6, 1.0, 3)
    return box_uvs(build(vertices, faces), 0.5)


def displaced_box(rng: Rng) -> Mesh:
    """Return a cushion: a rounded box with noise on it."""
    vertices, faces = icosphere(4)
    power = rng.uniform(4, 12)
    vertices = vertices / (np.abs(vertices) ** power).sum(1, keepdims=True) ** (1 / power)
    value = SpaceNoise(rng).fbm(vertices * rng.uniform(1.5, 5.0) + 8, 4)
    vertices = vertices * (1 + rng.uniform(0.03, 0.2) * value)[:, None] * rng.uniform(0.3, 1.0, 3)
    return box_uvs(build(vertices, faces), 0.5)


def extruded(outline: Floats, height: float, bevel: float, steps: int = 4) -> Mesh:
    """Return a star-shaped outline (N, 2), counter-clockwise, not repeated, as a prism about the Y axis."""
    closed = np.concatenate([outline, outline[:1]])
    levels = np.linspace(-height + bevel, height - bevel, steps)
    rings = [(1 - bevel, -height), *((1.0, y) for y in levels), (1 - bevel, height)]
    rings = [(0.0, -height), *rings, (0.0, height)]
    points = np.stack([np.insert(closed * s, 1, y, 1) for s, y in rings])
    vertices = points.reshape(-1, 3)
    mesh = flat(vertices, grid_faces(*points.shape[:2]))
    return box_uvs(outward(mesh), 0.5)


def prism(rng: Rng) -> Mesh:
    """Return a regular or star-shaped prism with bevelled edges, twisted or tapered at times."""
    sides = int(rng.integers(3, 10))
    star = rng.random() < 0.5
    angle = np.linspace(0, 2 * np.pi, 8 * sides, endpoint=False)
    phase = (angle * sides / (2 * np.pi)) % 1
    if star:
        radius = 1 - rng.uniform(0.2, 0.55) * (1 - np.abs(2 * phase - 1))
    else:
        radius = np.cos(np.pi / sides) / np.cos((phase - 0.5) * 2 * np.pi / sides)
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    return extruded(outline, rng.uniform(0.15, 1.2), rng.uniform(0.02, 0.12), int(rng.integers(4, 9)))


def gear(rng: Rng) -> Mesh:
    """Return a cog wheel with a hole."""
    teeth = int(rng.integers(8, 25))
    angle = np.linspace(0, 2 * np.pi, 12 * teeth + 1)
    phase = (angle * teeth / (2 * np.pi)) % 1
    tooth = np.clip(2.5 - np.abs(phase - 0.5) * 8, 0, 1)
    radius = 1 - rng.uniform(0.1, 0.25) * (1 - tooth)
    inner, half = rng.uniform(0.15, 0.5), rng.uniform(0.08, 0.3)
    rings = [
        (inner, -half),
        (radius, -half),
        (radius, 0),
        (radius, half),
        (inner, half),
        (inner, 0),
        (inner, -half),
    ]
    points = np.stack([np.stack([r * np.cos(angle), y + 0 * angle, r * np.sin(angle)], 1) for r, y in rings])
    points[:, -1] = points[:, 0]
    return box_uvs(outward(flat(points.reshape(-1, 3), grid_faces(*points.shape[:2]))), 0.5)


def rock(rng: Rng) -> Mesh:
    """Return a faceted stone: a ball cut by random planes, with a rough surface."""
    directions, faces = icosphere(4)
    planes = unit(rng.normal(size=(int(rng.integers(8, 24)), 3)))
    distance = rng.uniform(0.6, 1.0, len(planes))
    facing = directions @ planes.T
    radius = np.where(facing > 0.05, distance / np.maximum(facing, 0.05), 9.0).min(1)
    radius = np.minimum(radius, 1.3) * (1 + 0.06 * SpaceNoise(rng).fbm(directions * 3 + 8, 4))
    return box_uvs(flat(directions * radius[:, None] * rng.uniform(0.5, 1.0, 3), faces), 0.5)


def _clipped(polygons: list[Floats], normal: Floats, offset: float) -> list[Floats]:
    """Return a convex solid, given as polygons, cut to the side where normal . p <= offset, with its cap."""
    kept, rim = [], []
    for polygon in polygons:
        side = polygon @ normal - offset
        points = []
        for k in range(len(polygon)):
            a, b, sa, sb = polygon[k - 1], polygon[k], side[k - 1], side[k]
            if (sa <= 0) != (sb <= 0):
                point = a + sa / (sa - sb) * (b - a)
                points.append(point)
                rim.append(point)
            if sb <= 0:
                points.append(b)
        if len(points) >= 3:
            kept.append(np.array(points))
    if len(rim) >= 3:
        ring = np.array(rim)
        middle = ring.mean(0)
        x = unit(ring[0] - middle)
        angle = np.arctan2((ring - middle) @ np.cross(normal, x), (ring - middle) @ x)
        kept.append(ring[np.argsort(angle)])
    return kept


def _box_polygons(half: Floats) -> list[Floats]:
    polygons = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            quad = np.zeros((4, 3))
            quad[:, axis] = sign
            quad[:, b], quad[:, c] = [-1, 1, 1, -1], [-1, -1, 1, 1]
            polygons.append((quad if sign > 0 else quad[::-1]) * half)
    return polygons


def fragments(rng: Rng) -> Mesh:
    """Return a box broken into Voronoi cells that have drifted apart."""
    half = rng.uniform(0.4, 0.9, 3)
    seeds = rng.uniform(-1, 1, (int(rng.integers(5, 11)), 3)) * half
    gap, pieces = rng.uniform(0.05, 0.4), []
    for i, seed in enumerate(seeds):
        polygons = _box_polygons(half)
        for other in np.delete(seeds, i, 0):
            normal = unit(other - seed)
            polygons = _clipped(polygons, normal, float(normal @ (seed + other) / 2))
        fans = [np.stack([p[0], p[k], p[k + 1]]) for p in polygons for k in range(1, len(p) - 1)]
        turn = random_turn(rng) if rng.random() < 0.1 else np.eye(3)
        pieces.append((np.concatenate(fans) - seed) @ turn.T + seed * (1 + gap))
    vertices = np.concatenate(pieces)
    corners = np.arange(len(vertices)).reshape(-1, 3)
    return box_uvs(flat(*divided(*divided(vertices, corners))), 0.7)


def towers(rng: Rng) -> Mesh:
    """Return a field of blocks of different heights."""
    count = int(rng.integers(6, 10))
    quads = [np.stack([p[[0, 1, 2]], p[[0, 2, 3]]]) for p in _box_polygons(np.ones(3))]
    block = np.concatenate(quads).reshape(-1, 3)
    half = rng.uniform(0.3, 0.5, (count, count, 3))
    half[..., 1] = (rng.gamma(1.5, 0.5, (count, count)) + 0.1) * rng.uniform(0.25, 1.0)
    z, x = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    middle = np.stack([x, half[..., 1], z], -1)
    vertices = (block * half[:, :, None] + middle[:, :, None]).reshape(-1, 3)
    return box_uvs(flat(vertices, np.arange(len(vertices)).reshape(-1, 3)))
