"""Samples turn with their image: normals, motion, lens positions stay those of the turned surface."""

from __future__ import annotations

import numpy as np
import pytest

from data.augment import ORDERS, Augmentation, Change, Turn, turned
from data.augment_samples import changed, moves, subset
from data.buffers import sample_channels
from data.exr import read_frame
from data.root import resolve_root

CHANNELS = sample_channels("radiance", "normal", "motion", "lens", "offset", "depth")
TURNS = [Turn(number) for number in range(8)]


def surface(size: int = 9) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.random((size, size)).astype(np.float32)


def slopes(height: np.ndarray) -> np.ndarray:
    """Samples (1, C, H, W) of which every vector is the slope of a height, in its own axes."""
    down, right = np.gradient(height)
    zero = np.zeros_like(height)
    normal = [right, -down, height]  # x to the right, y up
    lens = [-right, -down]  # x to the left, y up
    offset = [0.5 + right, 0.5 + down]
    return np.stack([height, zero, zero, *normal, right, down, *lens, *offset, height])[None]


@pytest.mark.parametrize("turn", TURNS)
def test_vectors_of_a_turned_surface_are_its_turned_vectors(turn: Turn) -> None:
    height = surface()
    found = np.empty_like(slopes(height))
    changed(slopes(height), CHANNELS, Change(turn), found)
    np.testing.assert_allclose(found, slopes(turned(height[None], turn)[0]), atol=1e-6)


def test_lengths_and_handedness_of_normals_are_kept_by_every_turn() -> None:
    for turn in TURNS:
        source, scale, _ = moves(sample_channels("normal"), Change(turn))
        matrix = np.eye(3)[source] * scale[:, None]
        mirrored = bin(turn).count("1") % 2
        assert np.linalg.det(matrix) == pytest.approx(-1 if mirrored else 1)


def test_colours_and_axes_are_permuted_after_the_turn() -> None:
    change = Change(Turn.FLIP_X, (2, 0, 1), (1, 2, 0), (1.0, -1.0, 1.0))
    values = np.arange(1, 7, dtype=np.float32).reshape(1, 6, 1, 1)
    found = np.empty_like(values)
    changed(values, sample_channels("specular_albedo", "normal"), change, found)
    assert found.ravel().tolist() == [3.0, 1.0, 2.0, 5.0, -6.0, -4.0]


def test_what_is_not_a_vector_keeps_its_value() -> None:
    channels = sample_channels("depth", "roughness", "coc", "time", "visibility")
    source, scale, shift = moves(channels, Change(Turn(7), ORDERS[4], ORDERS[3], (-1.0, 1.0, -1.0)))
    assert source.tolist() == list(range(len(channels)))
    assert scale.tolist() == [1.0] * len(channels)
    assert not shift.any()


def test_angles_of_unknown_axes_are_refused_by_name() -> None:
    channels = sample_channels("radiance", "light_direction")
    moves(channels, Change(colors=(1, 0, 2)))
    with pytest.raises(ValueError, match="samples with light_direction are not flipped"):
        moves(channels, Change(Turn.FLIP_Y))


@pytest.mark.parametrize("scene", ["outdoor-000101", "indoor-000102"])
def test_rendered_lens_positions_are_to_the_left_and_up(scene: str) -> None:
    """Behind the focus a point moves against the position on the lens: to the right for one on the left."""
    samples = read_frame(resolve_root("sample:layers").path / scene / "f000.exr").samples
    assert samples is not None
    lens, radius = samples.get("lens"), samples.get("coc")[..., 0].mean(0) / 2
    lens = lens - lens.mean(0)
    seen = samples.get("normal")[..., 0]
    down, right = np.gradient(seen.mean(0))
    moved = (lens * (seen - seen.mean(0))[..., None]).sum(0) / (lens**2).sum(0)
    for axis, gradient in enumerate((right, down)):
        assert np.corrcoef(moved[..., axis].ravel(), (radius * gradient).ravel())[0, 1] > 0.15


def test_every_sample_is_kept_about_equally_often() -> None:
    counts = np.zeros(8)
    for number in range(2000):
        kept = subset(8, 3, 1, 0, number)
        assert len(set(kept)) == 3
        counts[kept] += 1
    assert counts.min() > 0.85 * 750
    assert counts.max() < 1.15 * 750


def test_sample_counts_cover_the_range_and_never_exceed_what_is_held() -> None:
    augmentation = Augmentation("none", samples=(2, 5))
    assert {augmentation.sample_count(0, number, 8) for number in range(100)} == {2, 3, 4, 5}
    assert {augmentation.sample_count(0, number, 3) for number in range(100)} == {2, 3}
    assert {augmentation.sample_count(0, number, 1) for number in range(9)} == {1}
