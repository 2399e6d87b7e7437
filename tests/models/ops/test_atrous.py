"""Edge-stopping means: kernels, and which edges stop them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.atrous import (
    EdgeStops,
    Surfaces,
    Tap,
    atrous_taps,
    box_taps,
    edge_stopping_means,
    luminance,
    smoothed_variance,
)

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = 11
WIDE = torch.tensor(1e30, dtype=torch.float64)
"""A spread of luminances that no edge stops."""


def wall(slope: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return normal and depth of a wall whose depth grows to the right."""
    normal = torch.zeros(1, 3, SIZE, SIZE, dtype=torch.float64)
    normal[:, 2] = 1
    depth = 5 + slope * torch.arange(SIZE, dtype=torch.float64).expand(1, 1, SIZE, -1)
    return normal, depth


def surfaces(wall: tuple[Tensor, Tensor], **stops: Any) -> Surfaces:
    return Surfaces(*wall, 4, EdgeStops(**stops))


def impulse(row: int = 5, column: int = 5) -> Tensor:
    lit = torch.zeros(1, 3, SIZE, SIZE, dtype=torch.float64)
    lit[..., row, column] = 1
    return lit


def means(lit: Tensor, where: Surfaces, taps: list[Tap], spread: Tensor = WIDE) -> Tensor:
    return edge_stopping_means(lit, lit[:, :1], spread, where, taps).values


@pytest.mark.parametrize("step", [1, 2])
def test_on_a_wall_an_impulse_becomes_the_spline_kernel_with_holes(step: int) -> None:
    found = means(impulse(), surfaces(wall()), atrous_taps(step))[0, 0]
    line = torch.tensor([1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16], dtype=torch.float64)
    expected = torch.zeros(SIZE, SIZE, dtype=torch.float64)
    at = slice(5 - 2 * step, 6 + 2 * step, step)
    expected[at, at] = line[:, None] * line
    # Rows near the border have lost taps, so that the rest weighs more; the impulse is far enough from it.
    inner = slice(2 * step, SIZE - 2 * step)
    torch.testing.assert_close(found[inner, inner], expected[inner, inner])


def test_variances_have_the_squares_of_the_weights_over_the_square_of_their_sum() -> None:
    lit = impulse()
    found = edge_stopping_means(lit, lit[:, :1], WIDE, surfaces(wall()), atrous_taps(1))
    torch.testing.assert_close(found.variances[..., 2:9, 2:9], found.values[:, :1, 2:9, 2:9].square())


def test_a_box_weighs_all_alike_and_pixels_outside_take_no_part() -> None:
    found = means(impulse(0, 0), surfaces(wall()), box_taps(3))[0, 0]
    assert found[0, 0].item() == pytest.approx(1 / 16)
    assert found[3, 3].item() == pytest.approx(1 / 49)
    assert found[4, 4].item() == 0


def test_a_constant_stays_constant_beside_every_edge() -> None:
    generator = torch.Generator().manual_seed(2)
    normal = F.normalize(torch.rand(1, 3, SIZE, SIZE, generator=generator, dtype=torch.float64) - 0.3, dim=1)
    depth = torch.rand(1, 1, SIZE, SIZE, generator=generator, dtype=torch.float64).round() * 3
    lit = torch.full((1, 3, SIZE, SIZE), 0.7, dtype=torch.float64)
    found = means(lit, surfaces((normal, depth)), atrous_taps(2), torch.tensor(0.1))
    torch.testing.assert_close(found, lit, rtol=1e-12, atol=0)


def test_an_oblique_wall_is_filtered_with_the_weights_of_its_slope() -> None:
    right, diagonal = Tap(0, 1, 1.0), Tap(1, 1, 1.0)
    centre = Tap(0, 0, 1.0)
    found = means(impulse(), surfaces(wall(0.5)), [centre, right])[0, 0, 5, 4].item()
    weight = torch.tensor(-1.0).exp().item()  # the change is just what the slope explains
    assert found == pytest.approx(weight / (1 + weight))
    found = means(impulse(), surfaces(wall(0.5)), [centre, diagonal])[0, 0, 4, 4].item()
    weight = torch.tensor(-1 / 2**0.5).double().exp().item()
    assert found == pytest.approx(weight / (1 + weight))
    found = means(impulse(), surfaces(wall(0.5), slope="along"), [centre, diagonal])[0, 0, 4, 4].item()
    weight = torch.tensor(-1.0).exp().item()
    assert found == pytest.approx(weight / (1 + weight))


def test_a_step_in_depth_is_not_crossed() -> None:
    normal, depth = wall(0.01)
    depth = depth.clone()
    depth[..., 6:] += 1
    found = means(impulse(5, 6), surfaces((normal, depth)), atrous_taps(1))[0, 0]
    assert found[:, :6].max() < 1e-12
    assert found[5, 7] > 0.01


def test_an_edge_of_normals_is_crossed_as_its_cosine_to_the_power_says() -> None:
    normal, depth = wall()
    normal = normal.clone()
    normal[..., 5:] = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)[:, None, None]
    taps = [Tap(0, 0, 1.0), Tap(0, 1, 1.0)]
    found = means(impulse(), surfaces((normal, depth), normal=3.0), taps)[0, 0, 5, 4].item()
    assert found == pytest.approx(0.8**3 / (1 + 0.8**3))
    normal[..., 5:] *= -1
    assert means(impulse(), surfaces((normal, depth)), taps)[0, 0, 5, 4] == 0


def test_what_hit_nothing_passes_through_and_weighs_nothing() -> None:
    normal, depth = wall()
    depth = depth.clone()
    depth[..., 5, 5] = 0
    lit = impulse()
    assert torch.equal(means(lit, surfaces((normal, depth)), atrous_taps(1)), lit)


def test_luminances_that_differ_by_the_spread_weigh_1_over_e() -> None:
    lit = torch.tensor([0.4, 0.5, 0.25], dtype=torch.float64)[:, None, None] * impulse()
    spread = luminance(lit).amax()
    assert spread.item() == pytest.approx(0.2126 * 0.4 + 0.7152 * 0.5 + 0.0722 * 0.25)
    found = means(lit, surfaces(wall()), [Tap(0, 0, 1.0), Tap(0, 1, 1.0)], spread)[0, :, 5, 4]
    weight = torch.tensor(-1.0).exp().item()
    torch.testing.assert_close(found, lit[0, :, 5, 5] * weight / (1 + weight), rtol=1e-6, atol=0)


def test_the_variance_is_smoothed_by_a_small_gaussian_of_the_pixels_inside() -> None:
    variance = impulse()[:, :1]
    found = smoothed_variance(variance)[0, 0]
    assert found[4:7, 4:7].flatten().tolist() == [
        1 / 16,
        1 / 8,
        1 / 16,
        1 / 8,
        1 / 4,
        1 / 8,
        1 / 16,
        1 / 8,
        1 / 16,
    ]
    assert found.sum().item() == pytest.approx(1)
    assert smoothed_variance(impulse(0, 0)[:, :1])[0, 0, 0, 0].item() == pytest.approx(4 / 9)
    assert smoothed_variance(torch.full((1, 1, 1, 1), 3.0)).item() == 3


def test_gradients_are_those_of_finite_differences() -> None:
    normal, depth = (image[..., :4, :4] for image in wall(0.3))
    where = Surfaces(normal, depth, 2, EdgeStops())
    generator = torch.Generator().manual_seed(5)
    lit = torch.rand(1, 3, 4, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    spread = torch.tensor(0.3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: means(x, where, atrous_taps(1), spread), lit)


def rough(height: int = 37, width: int = 300) -> tuple[Tensor, Tensor, Tensor]:
    """Return normal, depth and light of boards before a sky, with noise on all of them, in float32."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(1, 8, height, width, generator=generator)
    depth = 4 + (torch.arange(width) // 40 % 3) + 0.02 * torch.arange(height)[:, None] + 0.01 * noise[:, :1]
    normal = F.normalize(torch.tensor([0.1, 0.2, 1.0])[:, None, None] + 0.1 * noise[:, 1:4], dim=1)
    depth[..., :5, 20:90] = 0
    return normal, depth, noise[:, 4:7] * (1 + 50 * (noise[:, 7:] > 0.99))


@pytest.mark.parametrize("slope", ["steepest", "along"])
@pytest.mark.parametrize("taps", [box_taps(3), atrous_taps(1), atrous_taps(4)], ids=len)
def test_compiled_kernels_average_like_the_others(slope: Any, taps: list[Tap]) -> None:
    normal, depth, light = rough()
    where = Surfaces(normal, depth, 8, EdgeStops(0.7, 64.0, slope))
    spread = 0.1 + light[:, 1:2]
    variances = torch.cat([light[:, :1].square(), light[:, 2:]], 1)
    for kinds in (variances, variances[:, :0]):
        found, expected = (
            edge_stopping_means(light, kinds, spread, where, taps, fused=fused) for fused in (True, False)
        )
        torch.testing.assert_close(found.values, expected.values, rtol=2e-5, atol=1e-6)
        torch.testing.assert_close(found.variances, expected.variances, rtol=4e-5, atol=1e-6)
    assert (expected.values - light).abs().max() > 1


def test_compiled_kernels_average_every_image_of_a_batch_by_itself() -> None:
    normal, depth, light = (torch.cat([x, x.flip(-1)]) for x in rough(20, 40))
    where, taps = Surfaces(normal, depth, 4, EdgeStops()), atrous_taps(2)
    found = edge_stopping_means(light, light[:, :1], torch.tensor(1.0), where, taps, fused=True)
    expected = edge_stopping_means(light, light[:, :1], torch.tensor(1.0), where, taps, fused=False)
    torch.testing.assert_close(found.values, expected.values, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize(("exponent", "doublings"), [(128.0, 7), (1.0, 0), (0.5, None), (96.0, None)])
def test_only_powers_of_two_are_made_of_squares(exponent: float, doublings: int | None) -> None:
    assert surfaces(wall(), normal=exponent).doublings() == doublings
