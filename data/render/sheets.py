"""Thin and open shapes made face by face: plates with holes, tufts of blades, pieces of land."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.render.noise import SpaceNoise
from data.render.spec import Mesh
from data.render.surfaces import affine, box_uvs, build, flat, grid_faces, grid_mesh, joined, transformed

Floats = NDArray[np.float64]
Rng = np.random.Generator


def plate(rng: Rng) -> Mesh:
    """Return a plate with a grid of round or angular holes."""
    rows, columns = (int(n) for n in rng.integers(2, 7, 2))
    radius, half, sides = rng.uniform(0.2, 0.42), rng.uniform(0.03, 0.25), [24, 6, 4, 8][rng.integers(4)]
    t = np.linspace(0, 2 * np.pi, 25) + np.pi / 4
    corner = np.stack([np.cos(t), np.sin(t)], 1)
    square = 0.5 * corner / np.abs(corner).max(1, keepdims=True)
    step = 2 * np.pi / sides
    hole = corner * radius * (np.cos(step / 2) / np.cos((t % step) - step / 2))[:, None]
    lines = [
        np.insert(o, 1, y, 1)
        for o, y in ((square, -half), (square, half), (hole, half), (hole, -half), (square, -half))
    ]
    strips = [flat(np.concatenate(lines[k : k + 2]), grid_faces(2, 25)) for k in range(1, 4)]
    tile = joined([box_uvs(s) for s in strips])
    tiles = []
    for i in range(columns):
        for j in range(rows):
            at = affine(np.eye(3), [i - (columns - 1) / 2, 0.0, j - (rows - 1) / 2])
            tiles.append(transformed(tile, at))
            # The four sides of the outline in its order: far, left, near, right.
            outer = (j == rows - 1, i == 0, j == 0, i == columns - 1)
            for side in np.flatnonzero(outer):
                part = [line[6 * side : 6 * side + 7] for line in lines[:2]]
                tiles.append(transformed(box_uvs(flat(np.concatenate(part), grid_faces(2, 7))), at))
    return joined(tiles)


def blades(rng: Rng) -> Mesh:
    """Return a tuft of grass, leaves or stiff hairs: bent strips that taper."""
    count, steps = int(rng.integers(80, 300)), 6
    t = np.linspace(0, 1, steps)
    width, bend = rng.uniform(0.01, 0.06), rng.uniform(0.1, 0.9)
    shape = np.sin(np.pi * np.clip(t * 0.8 + 0.15, 0, 1)) if rng.random() < 0.4 else 1 - t**2
    angle, tilt = rng.uniform(0, 2 * np.pi, (count, 1)), rng.uniform(0, 0.5, (count, 1))
    height, root = rng.uniform(0.5, 1.0, (count, 1)), rng.normal(0, 0.25, (count, 2))
    lean = tilt * t + bend * t**2 * rng.uniform(0.5, 1.0, (count, 1))
    x, y = root[:, :1] + lean * height * np.cos(angle), height * t * (1 - 0.25 * lean)
    middle = np.stack([x, y, root[:, 1:] + lean * height * np.sin(angle)], -1)
    across = np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], -1) * width
    edge = (shape + 0.02)[None, :, None] * across
    points = np.stack([middle - edge, middle + edge], 2).reshape(-1, 3)
    faces = np.concatenate([grid_faces(steps, 2) + 2 * steps * i for i in range(count)])
    u, v = np.tile([0.0, 1.0], count * steps), np.tile(np.repeat(t, 2), count)
    return build(points, faces, np.stack([u, v], 1))


def terrain(rng: Rng) -> Mesh:
    """Return a block of land: noise on top, straight sides, a flat bottom."""
    count = 41
    axis = np.linspace(-1, 1, count)
    z, x = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], 1)
    height = SpaceNoise(rng).fbm(points * rng.uniform(1.0, 3.0) + 8, 5) * rng.uniform(0.3, 1.0)
    if rng.random() < 0.4:
        height = np.abs(height)
    points[:, 1] = height
    top = grid_mesh(points.reshape(count, count, 3), (2.0, 2.0))
    grid, base = points.reshape(count, count, 3), float(height.min()) - rng.uniform(0.1, 0.4)
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[::-1, 0]])
    low = rim * [1, 0, 1] + np.array([0, base, 0])
    centre = np.zeros_like(rim) + np.array([0, base, 0])
    wall = box_uvs(flat(np.concatenate([low, rim]), grid_faces(2, len(rim))))
    floor = box_uvs(flat(np.concatenate([centre, low]), grid_faces(2, len(rim))))
    return joined([top, wall, floor])
