"""Regression in blocks: where they lie, what noise does, what is fitted exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.block_regression import OFFSETS, BlockRegression, hashed, mirrored, noise_of, solve
from tests.models.plain_bmfr import Options, mirror, regression, uniform
from tests.models.sequences import image

pytestmark = pytest.mark.usefixtures("one_thread")


def random(height: int, width: int, seed: int = 0, batch: int = 1) -> dict[str, Tensor]:
    """Return noisy light on a curved surface, with positions of several units."""
    generator = torch.Generator().manual_seed(seed)

    def noise() -> Tensor:
        return torch.rand(batch, 3, height, width, generator=generator, dtype=torch.float64)

    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    plane = torch.stack([0.1 * columns, 0.1 * rows, (0.2 * columns).sin() + 0.05 * rows])
    return {
        "light": -torch.log1p(-noise()),
        "normal": F.normalize(noise() - 0.5, dim=1),
        "position": plane + 0.02 * noise() + 2,
    }


def frames(*numbers: int) -> Tensor:
    return torch.tensor(numbers)


def arrays(buffers: dict[str, Tensor], b: int = 0) -> dict[str, Any]:
    return {name: image(plane[b : b + 1]) for name, plane in buffers.items()}


@pytest.mark.parametrize(("frame", "height", "width"), [(0, 20, 37), (1, 33, 5), (9, 1, 40), (13, 32, 32)])
def test_it_is_its_transcription(frame: int, height: int, width: int) -> None:
    given = random(height, width, frame)
    found = BlockRegression()(**given, frame=frames(frame)).clamp_min(0)
    expected = regression(arrays(given), arrays(given)["light"], frame, Options(1.0))
    np.testing.assert_allclose(image(found), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("how", "options"),
    [
        ({"scale": "all"}, Options(1.0, always_scale=True)),
        ({"half": True}, Options(1.0, half=True)),
        ({"noise": 0.1, "solver": "qr"}, Options(1.0, noise=0.1)),
    ],
    ids=str,
)
def test_with_options_it_is_its_transcription(how: dict[str, Any], options: Options) -> None:
    given = random(21, 18)
    found = BlockRegression(**how)(**given, frame=frames(3)).clamp_min(0)
    expected = regression(arrays(given), arrays(given)["light"], 3, options)
    np.testing.assert_allclose(image(found), expected, rtol=1e-8, atol=1e-9)


def test_each_image_of_a_batch_has_the_blocks_and_the_noise_of_its_own_frame() -> None:
    given = random(19, 23, batch=3)
    together = BlockRegression()(**given, frame=frames(0, 7, 30))
    for b, number in enumerate((0, 7, 30)):
        alone = {name: plane[b : b + 1] for name, plane in given.items()}
        found = BlockRegression()(**alone, frame=frames(number))
        torch.testing.assert_close(together[b : b + 1], found, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("frame", range(16))
def test_blocks_of_32_pixels_begin_at_the_offset_of_their_frame(frame: int) -> None:
    # Light that is 1 in one block of the grid and 0 elsewhere is fitted exactly, by constants; the block is
    # so far inside that none of its pixels are mirrored.
    right, down = OFFSETS[frame]
    light = torch.zeros(1, 3, 128, 128, dtype=torch.float64)
    light[..., down + 48 : down + 80, right + 48 : right + 80] = 1
    empty = torch.zeros_like(light)
    found = BlockRegression()(light, empty, empty, frames(frame + 16))
    torch.testing.assert_close(found, light, rtol=0, atol=1e-9)


def test_there_are_16_different_offsets_all_even_and_within_half_a_block() -> None:
    assert len(set(OFFSETS)) == 16
    assert all(value % 2 == 0 and -16 <= value <= 16 for offset in OFFSETS for value in offset)


def test_the_image_is_mirrored_at_both_ends_as_often_as_it_takes() -> None:
    places = torch.arange(-40, 60)
    for size in (1, 3, 32, 50):
        assert mirrored(places, size).tolist() == [mirror(i, size) for i in range(-40, 60)]
    assert mirrored(torch.tensor([-2, -1, 0, 4, 5, 6]), 5).tolist() == [1, 0, 0, 4, 4, 3]


def test_noise_is_the_hash_of_pixel_feature_and_frame() -> None:
    found = noise_of(frames(0, 5, 10**7))
    assert found.shape == (3, 1024, 9)
    for b, number in enumerate((0, 5, 10**7)):
        for pixel, feature in ((0, 1), (1023, 9), (37, 4)):
            assert found[b, pixel, feature - 1].item() == uniform(pixel, feature, number)
    assert hashed(torch.tensor([0, 1])).tolist() == [0, 0x514E28B7]  # published values of the finaliser


def test_noise_is_uniform_and_differs_between_pixels_features_and_frames() -> None:
    found = noise_of(torch.arange(4)).permute(0, 2, 1).reshape(36, 1024)
    assert found.abs().max() <= 1
    assert found.mean(1).abs().max() < 0.1
    assert (found.square().mean(1) - 1 / 3).abs().max() < 0.05
    correlation = torch.corrcoef(found) - torch.eye(36, dtype=torch.float64)
    assert correlation.abs().max() < 0.15


@pytest.mark.parametrize("level", [0.0, 0.7, 1e6])
def test_a_constant_is_fitted_exactly_whatever_the_features(level: float) -> None:
    given = {**random(24, 40), "light": torch.full((1, 3, 24, 40), level, dtype=torch.float64)}
    torch.testing.assert_close(
        BlockRegression()(**given, frame=frames(2)), given["light"], rtol=1e-9, atol=1e-12
    )


def test_a_linear_combination_of_features_is_fitted_the_better_the_less_noise() -> None:
    given = random(40, 40)
    position, normal = given["position"], given["normal"]
    light = 2 + 0.3 * position + 0.1 * position.flip(1).square() - 0.5 * normal.roll(1, 1)
    errors = [
        (BlockRegression(noise)(light, normal, position, frames(0)) - light).abs().max().item()
        for noise in (1e-2, 1e-3, 1e-4)
    ]
    assert errors[0] < 0.05
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def test_on_a_wall_whose_features_depend_on_each_other_noise_is_averaged() -> None:
    given = random(48, 48)
    rows, columns = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
    wall = torch.stack([0.1 * columns, 0.1 * rows, 0.1 * columns])[None].double()
    normal = torch.zeros_like(wall)
    normal[:, 2] = 1
    found = BlockRegression()(given["light"], normal, wall, frames(0))
    assert found.isfinite().all()
    assert (found - 1).square().mean() < 0.05 * (given["light"] - 1).square().mean()


@pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
def test_normal_equations_and_qr_give_the_same(kind: torch.dtype) -> None:
    given = {name: plane.to(kind) for name, plane in random(30, 30).items()}
    one, other = (BlockRegression(solver=how)(**given, frame=frames(0)) for how in ("normal", "qr"))  # type: ignore[arg-type]
    torch.testing.assert_close(one, other, rtol=0, atol=1e-4 if kind == torch.float32 else 1e-10)


def test_float32_differs_by_rounding_even_far_from_the_origin() -> None:
    given = random(30, 30)
    given["position"] = given["position"] + 300
    expected = BlockRegression()(**given, frame=frames(0))
    single = {name: plane.float() for name, plane in given.items()}
    found = BlockRegression()(**single, frame=frames(0))
    assert (found - expected).abs().max() < 0.02 * expected.abs().max()


def test_positions_in_other_units_change_nothing_where_all_ranges_are_scaled() -> None:
    given = random(30, 30)
    scaled = {**given, "position": 0.01 * given["position"]}
    method = BlockRegression(scale="all")
    expected = method(**given, frame=frames(0))
    torch.testing.assert_close(method(**scaled, frame=frames(0)), expected)
    assert (BlockRegression()(**scaled, frame=frames(0)) - expected).abs().max() > 0.01


def test_autocast_changes_nothing() -> None:
    given = {name: plane.float() for name, plane in random(20, 20).items()}
    expected = BlockRegression()(**given, frame=frames(0))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(BlockRegression()(**given, frame=frames(0)), expected)


@pytest.mark.parametrize("solver", ["normal", "qr"])
def test_gradients_are_those_of_finite_differences(solver: Any) -> None:
    generator = torch.Generator().manual_seed(0)
    features, light = (
        torch.rand(2, 9, count, generator=generator, dtype=torch.float64, requires_grad=True)
        for count in (4, 3)
    )
    assert torch.autograd.gradcheck(lambda f, c: solve(f, c, solver), (features, light))
