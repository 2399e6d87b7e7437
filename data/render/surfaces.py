"""Meshes from points and faces: normals, texture coordinates, winding, joining, moving, scaling."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.render.spec import Mesh

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]


def unit(vectors: Floats) -> Floats:
    """Return vectors (…, 3) scaled to length 1; vectors without a length become +Y."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def face_normals(vertices: Floats, faces: Faces) -> Floats:
    """Return the cross product of the edges of faces (M, 3): twice the area long, outward as the winding."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], 1)


def gathered(faces: Faces, values: Floats, count: int) -> Floats:
    """Return for each of `count` vertices the sum of the values (M, 3) of its faces (M, 3)."""
    corners, repeated = faces.T.reshape(-1), np.tile(values, (3, 1))
    return np.stack([np.bincount(corners, repeated[:, k], count) for k in range(3)], 1)


def volume(mesh: Mesh) -> float:
    """Return the signed volume of a closed mesh; negative: it is inside out."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _welded(vertices: Floats) -> NDArray[np.int64]:
    """Return for every vertex the number of its position, equal for vertices at the same place."""
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    # The odd offset keeps round coordinates, which many shapes have, away from the steps of the floor.
    x, y, z = np.floor((vertices - vertices.min(0)) / size * 2**20 + 0.37).astype(np.int64).T
    return np.unique((x << 42) | (y << 21) | z, return_inverse=True)[1].reshape(-1)


def build(vertices: Floats, faces: Faces, uvs: Floats | None = None, normals: Floats | None = None) -> Mesh:
    """Return a mesh; faces without an area are dropped, missing normals are smooth ones."""
    cross = face_normals(vertices, faces)
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    keep = np.linalg.norm(cross, axis=1) > 1e-10 * size**2
    faces, cross = faces[keep], cross[keep]
    if normals is None:
        number = _welded(vertices)
        normals = unit(gathered(number[faces], cross, int(number.max()) + 1))[number]
    return Mesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.uint32),
        np.ascontiguousarray(normals, np.float32),
        None if uvs is None else np.ascontiguousarray(uvs, np.float32),
    )


def flat(vertices: Floats, faces: Faces, uvs: Floats | None = None) -> Mesh:
    """Return a faceted mesh: every face has vertices and a normal of its own."""
    normals = np.repeat(unit(face_normals(vertices, faces)), 3, axis=0)
    corners = faces.reshape(-1)
    own = np.arange(len(corners)).reshape(-1, 3)
    return build(vertices[corners], own, None if uvs is None else uvs[corners], normals)


def grid_faces(rows: int, columns: int) -> Faces:
    """Return the faces of a grid of vertices; the front is at d/drow x d/dcolumn."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).reshape(-1)
    right, below, across = first + 1, first + columns, first + columns + 1
    return np.concatenate([np.stack([first, below, across], 1), np.stack([first, across, right], 1)])


def grid_mesh(points: Floats, repeat: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """Return the smooth surface through points (R, C, 3); closed ones repeat their first row or column.

    Args:
        points: The surface; its front is at d/drow x d/dcolumn.
        repeat: How often a texture repeats along the columns (u) and the rows (v).
    """
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(0, repeat[1], rows), np.linspace(0, repeat[0], columns), indexing="ij")
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return build(points.reshape(-1, 3), grid_faces(rows, columns), uvs)


def outward(mesh: Mesh) -> Mesh:
    """Return a closed mesh with its front outside."""
    if volume(mesh) >= 0:
        return mesh
    normals = None if mesh.normals is None else -mesh.normals
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), normals, mesh.uvs)


def box_uvs(mesh: Mesh, scale: float = 1.0) -> Mesh:
    """Return the mesh with texture coordinates projected along the main axis of each face.

    Vertices between faces of different main axes are doubled; a texture repeats every `1 / scale` units.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    cross = face_normals(vertices, faces)
    axis = np.abs(cross).argmax(1)
    pairs = faces * 3 + axis[:, None]
    unique, new = np.unique(pairs, return_inverse=True)
    source, along = unique // 3, unique % 3
    axes = np.array([[2, 1], [0, 2], [0, 1]])[along]
    uvs = np.take_along_axis(vertices[source], axes, axis=1) * scale
    normals = None if mesh.normals is None else mesh.normals[source]
    return build(vertices[source], new.reshape(-1, 3), uvs, normals)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of several that all have normals and texture coordinates.

    Raises:
        ValueError: There is none, or one lacks normals or texture coordinates.
    """
    if not meshes or any(m.normals is None or m.uvs is None for m in meshes):
        raise ValueError("only meshes with normals and texture coordinates can be joined")
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces.astype(np.int64) + start for m, start in zip(meshes, starts, strict=True)]
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate([m.normals for m in meshes if m.normals is not None]),
        np.concatenate([m.uvs for m in meshes if m.uvs is not None]),
    )


def transformed(mesh: Mesh, matrix: Floats) -> Mesh:
    """Return the mesh moved by a 4x4 matrix; a mirroring one turns the winding."""
    linear = matrix[:3, :3]
    vertices = (mesh.vertices @ linear.T + matrix[:3, 3]).astype(np.float32)
    normals = mesh.normals
    if normals is not None:
        normals = unit(normals.astype(np.float64) @ np.linalg.inv(linear)).astype(np.float32)
    faces = mesh.faces if np.linalg.det(linear) > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    return Mesh(vertices, faces, normals, mesh.uvs)


def normalised(mesh: Mesh) -> Mesh:
    """Return the mesh with the middle of its bounding box in the origin and a bounding sphere of radius 1."""
    vertices = mesh.vertices.astype(np.float64)
    vertices -= (vertices.min(0) + vertices.max(0)) / 2
    radius = max(float(np.linalg.norm(vertices, axis=1).max()), 1e-12)
    return Mesh((vertices / radius).astype(np.float32), mesh.faces, mesh.normals, mesh.uvs)


def rotation(axis: Floats, angle: float) -> Floats:
    """Return the 3x3 rotation by an angle in radians about an axis (3,)."""
    x, y, z = unit(np.asarray(axis, np.float64))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def affine(linear: Floats, offset: Floats | Sequence[float] = (0.0, 0.0, 0.0)) -> Floats:
    """Return the 4x4 matrix of a 3x3 linear map and an offset."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = offset
    return matrix
