"""Shapes given by a function that is negative inside: metaballs, minimal surfaces, blends, cut solids.

Meshing: surface nets (S. Gibson, Constrained elastic surface nets, MICCAI 1998, DOI 10.1007/BFb0056277) on a
grid, vectorised; the vertices are then moved onto the surface along the gradient, which also gives normals.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data.render.spec import Mesh
from data.render.surfaces import box_uvs, build, face_normals, gathered, rotation, unit

Floats = NDArray[np.float64]
Rng = np.random.Generator
Field = Callable[[Floats], Floats]
"""Points (N, 3) → (N,), negative inside."""

_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def gradient(field: Field, points: Floats, step: float = 1e-3) -> Floats:
    """Return the gradient of a field at points (N, 3) by central differences."""
    offsets = step * np.eye(3)
    return np.stack([(field(points + o) - field(points - o)) / (2 * step) for o in offsets], 1)


def _cell_vertices(values: Floats, active: NDArray[np.int64]) -> Floats:
    """Return for cells (N, 3) the mean of the zero crossings on their edges, in grid units."""
    corner = np.stack([values[tuple((active + c).T)] for c in _CORNERS], 1)
    total, count = np.zeros((len(active), 3)), np.zeros(len(active))
    for a, b in _EDGES:
        va, vb = corner[:, a], corner[:, b]
        crosses = (va < 0) != (vb < 0)
        t = np.where(crosses, va / np.where(crosses, va - vb, 1.0), 0.0)
        point = _CORNERS[a] + t[:, None] * (_CORNERS[b] - _CORNERS[a])
        total += np.where(crosses[:, None], point, 0.0)
        count += crosses
    return active + total / count[:, None]


def _quads(inside: NDArray[np.bool_], number: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return two triangles for every grid edge that crosses the surface, front outside."""
    faces = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        low = [slice(1, -1)] * 3
        high = [slice(1, -1)] * 3
        low[axis], high[axis] = slice(0, -1), slice(1, None)
        first, second = inside[tuple(low)], inside[tuple(high)]
        at = np.argwhere(first != second) + np.where(np.arange(3) == axis, 0, 1)
        leaves = inside[tuple(at.T)]
        eb, ec = np.eye(3, dtype=int)[b], np.eye(3, dtype=int)[c]
        ring = [number[tuple((at - d).T)] for d in (eb + ec, ec, 0 * eb, eb)]
        quad = np.stack(ring, 1)
        quad = np.where(leaves[:, None], quad, quad[:, ::-1])
        faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(faces)


def mesh_of(field: Field, bound: float = 1.1, resolution: int = 28) -> Mesh:
    """Return the surface of a field inside the cube [-bound, bound]^3, with normals and box coordinates.

    The field is taken as positive on the faces of the cube: what reaches them is cut off there.

    Raises:
        ValueError: The field has no surface in the cube.
    """
    axis = np.linspace(-bound, bound, resolution + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = field(points.reshape(-1, 3)).reshape(points.shape[:3])
    values = np.where(np.abs(values) < 1e-9, 1e-9, values)
    edge = np.pad(np.zeros((resolution - 1,) * 3, bool), 1, constant_values=True)
    values = np.where(edge, np.maximum(values, 1e-3), values)
    inside = values < 0
    count = sum(inside[tuple(slice(o, o + resolution) for o in c)].astype(int) for c in _CORNERS)
    active = np.argwhere((count > 0) & (count < 8))
    if len(active) == 0:
        raise ValueError("the field has no surface inside the cube")
    number = np.full((resolution,) * 3, -1)
    number[tuple(active.T)] = np.arange(len(active))
    cell = 2 * bound / resolution
    vertices = _cell_vertices(values, active) * cell - bound
    faces = _quads(inside, number)
    start = vertices.copy()
    for _ in range(2):
        slope = gradient(field, vertices)
        move = -field(vertices)[:, None] * slope / np.maximum((slope**2).sum(1, keepdims=True), 1e-6)
        vertices = np.clip(vertices + move, start - 0.5 * cell, start + 0.5 * cell)
    return box_uvs(build(vertices, faces, None, _normals(field, vertices, faces)), 0.5)


def _normals(field: Field, vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    """Return the gradient's direction where it agrees with the faces around a vertex, else their mean."""
    mean = unit(gathered(faces, face_normals(vertices, faces), len(vertices)))
    slope = unit(gradient(field, vertices))
    return np.where((mean * slope).sum(1, keepdims=True) > 0.7, slope, mean)


def length(vectors: Floats) -> Floats:
    """Return the lengths of vectors (N, 3); faster than `np.linalg.norm` along a short axis."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def ball(centre: Floats, radius: float) -> Field:
    """Return the distance to a sphere."""
    return lambda p: length(p - centre) - radius


def box(centre: Floats, half: Floats, turn: Floats, rounding: float = 0.05) -> Field:
    """Return the distance to a rounded box with half edges (3,), turned by a 3x3 rotation."""

    def distance(p: Floats) -> Floats:
        q = np.abs((p - centre) @ turn) - (half - rounding)
        x, y, z = q.T
        deepest = np.minimum(np.maximum(np.maximum(x, y), z), 0)
        return length(np.maximum(q, 0)) + deepest - rounding

    return distance


def capsule(a: Floats, b: Floats, radius: float) -> Field:
    """Return the distance to a cylinder from `a` to `b` with round ends."""

    def distance(p: Floats) -> Floats:
        t = np.clip((p - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-9), 0, 1)
        return length(p - a - t[:, None] * (b - a)) - radius

    return distance


def ring(centre: Floats, turn: Floats, radius: float, thickness: float) -> Field:
    """Return the distance to a torus."""

    def distance(p: Floats) -> Floats:
        q = (p - centre) @ turn
        return np.hypot(np.hypot(q[:, 0], q[:, 1]) - radius, q[:, 2]) - thickness

    return distance


def smooth_minimum(a: Floats, b: Floats, width: float) -> Floats:
    """Return min(a, b) with a polynomial transition of the given width."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - h * h * width / 4


def random_turn(rng: Rng) -> Floats:
    """Return a uniformly random 3x3 rotation, by Shoemake's quaternions."""
    u, v, w = rng.random(3)
    a, b = np.sqrt(1 - u), np.sqrt(u)
    x, y, z = a * np.sin(2 * np.pi * v), a * np.cos(2 * np.pi * v), b * np.sin(2 * np.pi * w)
    angle = 2 * np.arccos(np.clip(b * np.cos(2 * np.pi * w), -1, 1))
    return rotation(np.array([x, y, z]), float(angle))


def _primitive(rng: Rng, spread: float) -> Field:
    centre, turn = rng.uniform(-spread, spread, 3), random_turn(rng)
    kind = rng.integers(4)
    if kind == 0:
        return ball(centre, rng.uniform(0.2, 0.5))
    if kind == 1:
        return box(centre, rng.uniform(0.15, 0.5, 3), turn)
    if kind == 2:
        return capsule(centre, -centre + rng.uniform(-0.2, 0.2, 3), rng.uniform(0.1, 0.25))
    return ring(centre, turn, rng.uniform(0.25, 0.5), rng.uniform(0.08, 0.18))


def metaballs(rng: Rng) -> Mesh:
    """Return a few balls of a Gaussian field run together."""
    centres = rng.uniform(-0.6, 0.6, (rng.integers(3, 9), 3))
    radii = rng.uniform(0.15, 0.4, len(centres))

    def field(p: Floats) -> Floats:
        value = np.full(len(p), 0.5)
        for centre, radius in zip(centres, radii, strict=True):
            value -= np.exp(-((length(p - centre) / radius) ** 2) * np.log(2))
        return value

    return mesh_of(field, 1.15, 26)


def minimal_surface(rng: Rng) -> Mesh:
    """Return a sheet of a gyroid, a Schwarz P or a Schwarz D surface, cut by a ball or a box."""
    frequency, thickness = rng.uniform(4.0, 7.0), rng.uniform(0.35, 0.7)
    kind, shift, cut = rng.integers(3), rng.uniform(0, 6, 3), rng.integers(2)
    hull = ball(np.zeros(3), 0.95) if cut else box(np.zeros(3), np.full(3, 0.7), np.eye(3), 0.1)

    def field(p: Floats) -> Floats:
        x, y, z = (p * frequency + shift).T
        if kind == 0:
            value = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
        elif kind == 1:
            value = np.cos(x) + np.cos(y) + np.cos(z)
        else:
            value = np.sin(x) * np.sin(y) * np.sin(z) + np.cos(x) * np.cos(y) * np.cos(z)
        return np.maximum((np.abs(value) - thickness) / frequency, hull(p))

    return mesh_of(field, 1.0, 27)


def blend(rng: Rng) -> Mesh:
    """Return a few primitives melted together."""
    parts = [_primitive(rng, 0.45) for _ in range(rng.integers(3, 7))]
    width = rng.uniform(0.1, 0.4)

    def field(p: Floats) -> Floats:
        value = parts[0](p)
        for part in parts[1:]:
            value = smooth_minimum(value, part(p), width)
        return value

    return mesh_of(field, 1.2, 30)


def cut_solid(rng: Rng) -> Mesh:
    """Return a ball or box from which primitives are cut away."""
    if rng.random() < 0.5:
        body = ball(np.zeros(3), 0.9)
    else:
        body = box(np.zeros(3), rng.uniform(0.45, 0.8, 3), random_turn(rng))
    cuts = [_primitive(rng, 0.8) for _ in range(rng.integers(2, 6))]
    width = rng.uniform(0.02, 0.1)

    def field(p: Floats) -> Floats:
        value = body(p)
        for part in cuts:
            value = -smooth_minimum(-value, part(p), width)
        return value

    return mesh_of(field, 1.1, 30)
