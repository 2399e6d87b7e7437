from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from data.render.implicit import ball, mesh_of, random_turn
from data.render.noise import SpaceNoise, cell_noise, fbm, gradient_noise
from data.render.shapes import FAMILIES, random_family, random_mesh
from data.render.spec import Mesh
from data.render.surfaces import affine, box_uvs, face_normals, flat, joined, transformed, unit, volume
from data.render.swept import torus


def open_edges(mesh: Mesh) -> float:
    """Share of edges that no face uses the other way round, vertices at the same place taken as one."""
    size = np.ptp(mesh.vertices, axis=0).max()
    keys = np.round(mesh.vertices.astype(float) / size * 20011.3).astype(np.int64)
    number = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces.astype(int)]
    edges = np.concatenate([number[:, [0, 1]], number[:, [1, 2]], number[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    forth, back = edges[:, 0] * 10**7 + edges[:, 1], edges[:, 1] * 10**7 + edges[:, 0]
    return float((~np.isin(back, forth)).mean())


@cache
def drawn(family: str, seed: int) -> Mesh:
    return random_mesh(np.random.default_rng(seed), family)


@pytest.mark.parametrize("family", FAMILIES)
class TestEveryFamily:
    def test_fills_the_unit_ball_with_500_to_20000_triangles(self, family: str) -> None:
        for seed in range(2):
            mesh = drawn(family, seed)
            assert 500 <= len(mesh.faces) <= 20_000
            assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
            assert mesh.vertices.dtype == np.float32
            assert mesh.faces.dtype == np.uint32
            assert mesh.faces.max() < len(mesh.vertices)

    def test_normals_are_unit_vectors_on_the_front(self, family: str) -> None:
        mesh = drawn(family, 0)
        assert mesh.normals is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        faces = unit(face_normals(mesh.vertices.astype(float), mesh.faces.astype(int)))
        agrees = (faces * mesh.normals[mesh.faces].mean(1)).sum(1) > 0
        assert agrees.mean() > 0.97

    def test_has_texture_coordinates_that_vary(self, family: str) -> None:
        mesh = drawn(family, 1)
        assert mesh.uvs is not None
        assert mesh.uvs.shape == (len(mesh.vertices), 2)
        assert np.isfinite(mesh.uvs).all()
        assert (np.ptp(mesh.uvs, axis=0) > 0.1).all()

    def test_closed_ones_have_no_open_edge_and_their_front_outside(self, family: str) -> None:
        if FAMILIES[family].closed:
            for seed in range(2):
                mesh = drawn(family, seed)
                assert open_edges(mesh) < 0.002
                assert volume(mesh) > 0.01

    def test_same_generator_state_gives_the_same_mesh(self, family: str) -> None:
        first, second = drawn(family, 1), random_mesh(np.random.default_rng(1), family)
        np.testing.assert_array_equal(first.vertices, second.vertices)
        np.testing.assert_array_equal(first.faces, second.faces)
        other = drawn(family, 0)
        assert first.vertices.shape != other.vertices.shape or not np.array_equal(
            first.vertices, other.vertices
        )


def test_at_least_a_dozen_families_are_all_drawn() -> None:
    rng = np.random.default_rng(0)
    assert len(FAMILIES) >= 12
    assert {random_family(rng) for _ in range(1000)} == set(FAMILIES)


def test_surface_of_a_ball_has_its_volume_and_radial_normals() -> None:
    mesh = mesh_of(ball(np.zeros(3), 0.8), 1.0, 24)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals, unit(mesh.vertices.astype(float)), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.8, atol=1e-4)


def test_surface_that_leaves_the_cube_is_closed_at_its_faces() -> None:
    mesh = mesh_of(ball(np.array([0.9, 0, 0]), 0.5), 1.0, 20)
    assert open_edges(mesh) == 0
    assert volume(mesh) > 0


def test_field_without_a_surface_is_an_error() -> None:
    with pytest.raises(ValueError, match="no surface"):
        mesh_of(ball(np.full(3, 9.0), 0.5), 1.0, 8)


def test_mirroring_keeps_the_front_outside() -> None:
    mesh = torus(np.random.default_rng(0))
    mirrored = transformed(mesh, affine(np.diag([-1.0, 1.0, 1.0])))
    assert volume(mirrored) == pytest.approx(volume(mesh), rel=1e-4)
    assert mirrored.normals is not None
    np.testing.assert_allclose(mirrored.normals[:, 0], -np.asarray(mesh.normals)[:, 0], atol=1e-5)


def test_uneven_scaling_keeps_normals_perpendicular_to_the_faces() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 1]])
    mesh = transformed(flat(vertices, np.array([[0, 1, 2]])), affine(np.diag([1.0, 3.0, 0.5])))
    assert mesh.normals is not None
    normal = unit(face_normals(mesh.vertices.astype(float), mesh.faces.astype(int)))
    np.testing.assert_allclose(mesh.normals, np.repeat(normal, 3, 0), atol=1e-6)


def test_box_coordinates_do_not_change_the_surface() -> None:
    mesh = torus(np.random.default_rng(1))
    mapped = box_uvs(Mesh(mesh.vertices, mesh.faces, mesh.normals), 2.0)
    np.testing.assert_array_equal(mapped.vertices[mapped.faces], mesh.vertices[mesh.faces])


def test_meshes_without_texture_coordinates_are_not_joined() -> None:
    mesh = flat(np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="texture coordinates"):
        joined([mesh])


def test_random_turn_is_a_rotation() -> None:
    turn = random_turn(np.random.default_rng(0))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


@pytest.mark.parametrize("cells", [2, 7, 16])
def test_gradient_noise_tiles(cells: int) -> None:
    noise = gradient_noise(np.random.default_rng(0), 128, cells)
    inside = np.abs(np.diff(noise, axis=0)).max()
    assert np.abs(noise[0] - noise[-1]).max() <= inside * 1.5
    assert np.abs(noise[:, 0] - noise[:, -1]).max() <= np.abs(np.diff(noise, axis=1)).max() * 1.5


def test_gradient_noise_is_zero_at_lattice_points() -> None:
    # 64 pixels, 65 cells short of a whole pixel: sample middles never fall on points, so look between them.
    noise = gradient_noise(np.random.default_rng(0), 512, 4)
    corner = (noise[127:129, 127:129]).mean()
    assert abs(corner) < 0.01
    assert np.abs(noise).max() > 0.3


def test_sums_of_noise_stay_within_one() -> None:
    assert np.abs(fbm(np.random.default_rng(0), 64, 2, 6)).max() == pytest.approx(1)
    points = np.random.default_rng(1).uniform(-30, 30, (1000, 3))
    assert np.abs(SpaceNoise(np.random.default_rng(2)).fbm(points)).max() <= 1


def test_space_noise_has_no_steps() -> None:
    line = np.stack([np.linspace(-20, 20, 4001), np.full(4001, 0.3), np.full(4001, 1.7)], 1)
    assert np.abs(np.diff(SpaceNoise(np.random.default_rng(0))(line))).max() < 0.05


def test_cell_noise_orders_its_distances() -> None:
    cells = cell_noise(np.random.default_rng(0), 64, 5)
    assert (cells.nearest <= cells.second).all()
    assert set(np.unique(cells.label)) <= set(range(25))
