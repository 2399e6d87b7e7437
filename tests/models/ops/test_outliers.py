"""Outliers among similar neighbours go, everything else stays."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.ops.outliers import replace_outliers
from tests.models.plain_nbgd import plain_outliers

ONE = torch.ones(1, 1, 1, 1)


def surface(height: int = 9, width: int = 11) -> list[Tensor]:
    """A chequered light, which has no outliers, on a wall of one albedo and one normal; float64."""
    places = torch.arange(height, dtype=torch.float64)[:, None] + torch.arange(width)
    light = (0.5 + 0.05 * (places % 2)).repeat(1, 3, 1, 1)
    normal = torch.zeros_like(light)
    normal[:, 2] = 1.0
    return [light, torch.full_like(light, 0.6), normal]


def test_it_equals_the_rule_pixel_by_pixel() -> None:
    generator = torch.Generator().manual_seed(3)
    light, albedo, normal = surface(14, 13)
    light = light * torch.rand(light.shape, generator=generator, dtype=torch.float64) ** 4
    spots = torch.rand(1, 1, 14, 13, generator=generator) < 0.15
    light = torch.where(spots, light * 200, light)
    albedo = albedo + 0.3 * torch.rand(albedo.shape, generator=generator, dtype=torch.float64)
    normal[:, 0, :, 6:] = 0.4
    found = replace_outliers(light, albedo, normal, ONE)
    torch.testing.assert_close(found[0], plain_outliers(light[0], albedo[0], normal[0]), rtol=1e-12, atol=0)
    assert 5 < int((found != light).any(1).sum()) < 100


@pytest.mark.parametrize(("row", "column"), [(4, 5), (0, 0), (8, 3), (2, 10)])
def test_a_firefly_becomes_the_mean_of_its_neighbours(row: int, column: int) -> None:
    light, albedo, normal = surface()
    clean = light.clone()
    light[..., row, column] = 500.0
    found = replace_outliers(light, albedo, normal, ONE)
    near = (..., slice(max(0, row - 1), row + 2), slice(max(0, column - 1), column + 2))
    around, count = clean[near].sum((-2, -1)) - clean[..., row, column], clean[near][0, 0].numel() - 1
    torch.testing.assert_close(found[..., row, column], around / count)
    found[..., row, column] = light[..., row, column]
    assert torch.equal(found, light)


@pytest.mark.parametrize("feature", [1, 2])
def test_what_differs_in_albedo_or_normal_is_no_neighbour(feature: int) -> None:
    buffers = surface()
    buffers[0][..., 4, 5] = 500.0
    buffers[feature][:, 0, 4, 5] += 0.32  # squared: just above 0.1
    assert torch.equal(replace_outliers(*buffers, ONE), buffers[0])
    buffers[feature][:, 0, 4, 5] -= 0.01
    assert not torch.equal(replace_outliers(*buffers, ONE), buffers[0])


def test_exposure_decides_what_the_tone_curve_can_tell_apart() -> None:
    light, albedo, normal = surface()
    light[..., 4, 5] = 3.0
    assert replace_outliers(light, albedo, normal, ONE)[..., 4, 5].max() < 1
    dark = replace_outliers(light, albedo, normal, 1e-3 * ONE)  # all of it below the toe of the curve
    assert torch.equal(dark, light)


def test_a_constant_image_and_black_stay() -> None:
    for value in (0.0, 0.7, 1e12):
        light, albedo, normal = (buffer.float() for buffer in surface())
        constant = torch.full_like(light, value)
        found = replace_outliers(constant, albedo, normal, ONE)
        torch.testing.assert_close(found, constant, rtol=1e-6, atol=0)
