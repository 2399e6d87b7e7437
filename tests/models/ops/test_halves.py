"""Where halves and variances come from, and how good the estimates are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops import halves
from models.ops.halves import Noise, estimated_variance, halves_variance

NAMES = ("color", "color_a", "color_b", "color_variance")


def buffers(height: int = 12, width: int = 15) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {name: torch.rand(2, 3, height, width, generator=generator) for name in NAMES}


def noise(variance: Any, *shape: int, seed: int = 0) -> Tensor:
    return variance**0.5 * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def in_boxes(image: Tensor, radius: int) -> Any:
    """Mean over the part of each box that is inside, one pixel at a time."""
    array = image[0, 0].double().numpy()
    result = np.zeros_like(array)
    for y in range(array.shape[0]):
        for x in range(array.shape[1]):
            box = array[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            result[y, x] = box.mean()
    return result


@pytest.mark.parametrize(
    ("how", "names"),
    [
        ("measured", ("color_a", "color_b", "color_variance")),
        ("halves", ("color_a", "color_b")),
        ("variance", ("color", "color_variance")),
        ("estimated", ("color",)),
        ("none", ("color",)),
    ],
)
def test_only_the_named_buffers_are_read(how: Noise, names: tuple[str, ...]) -> None:
    assert halves.inputs("color", how) == names
    whole = buffers()
    found = halves.halves({name: whole[name] for name in names}, "color", how)
    independent = how in ("measured", "halves")
    assert halves.independent(how) == independent
    assert torch.equal(found.a, whole["color_a" if independent else "color"])
    assert torch.equal(found.b, whole["color_b" if independent else "color"])
    assert found.variance.shape == found.a.shape


def test_the_variance_is_half_of_that_of_each_half() -> None:
    whole = buffers()
    assert torch.equal(halves.halves(whole, "color", "measured").variance, whole["color_variance"])
    assert torch.equal(halves.halves(whole, "color", "variance").variance, 0.5 * whole["color_variance"])
    assert not halves.halves(whole, "color", "none").variance.any()
    single = noise(4.0, 1, 1, 200, 200)
    assert abs(halves.halves({"color": single}, "color", "estimated").variance.mean() - 2.06) < 0.1


def test_the_variance_from_halves_is_right_in_the_mean_for_any_smoothing() -> None:
    a, b = (noise(6.0, 1, 3, 200, 200, seed=seed) for seed in (0, 1))  # the mean has 3
    assert torch.equal(halves_variance(a, b, 0), (a - b).square() / 4)
    spread = []
    for smoothing in (0, 1, 3):
        found = halves_variance(a, b, smoothing)
        assert abs(found.mean() - 3.0) < 0.03
        spread.append(float(found.std() / 3.0))
    assert abs(spread[0] - 2**0.5) < 0.03  # one degree of freedom
    assert abs(spread[1] - 2**0.5 / 3) < 0.03  # nine
    assert abs(spread[2] - 2**0.5 / 7) < 0.03


@pytest.mark.parametrize("smoothing", [1, 2, 4])
def test_smoothing_is_the_mean_over_the_part_of_a_box_that_is_inside(smoothing: int) -> None:
    a, b = (torch.rand(1, 1, 5, 9, dtype=torch.float64) for _ in "ab")
    expected = in_boxes((a - b).square() / 4, smoothing)
    np.testing.assert_allclose(halves_variance(a, b, smoothing)[0, 0], expected, rtol=1e-12)


@pytest.mark.parametrize("level", [1e-4, 1.0, 25.0])
def test_the_estimate_from_one_buffer_finds_known_noise(level: float) -> None:
    found = estimated_variance(3.0 + noise(level, 1, 3, 300, 300))
    assert abs(found.mean() / level - 1.03) < 0.02  # the documented bias
    assert abs(found.median() / level - 0.98) < 0.02


def test_the_estimate_follows_noise_that_differs_from_place_to_place() -> None:
    levels = torch.linspace(0.5, 4.0, 400).expand(1, 3, 300, 400)
    found = estimated_variance(noise(levels, 1, 3, 300, 400)).mean((0, 1, 2))
    for column in (40, 200, 360):
        near = found[column - 20 : column + 20].mean() / levels[0, 0, 0, column]
        assert abs(near - 1.03) < 0.06


def test_the_estimate_takes_gradients_and_straight_edges_for_what_they_are_and_slanted_ones_for_noise() -> (
    None
):
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    smooth = torch.stack([2 + 0.5 * x - 0.25 * y, (x > 11) + (y > 7) * 3.0, 0 * x + 5])[None]
    assert not estimated_variance(smooth).any()
    slanted = (x > y)[None, None].float()
    found = estimated_variance(slanted)
    assert found[0, 0, 10, 10] > 0.04
    assert found[0, 0, 10, 20] == 0


def test_the_estimate_is_the_formula_at_the_border_too() -> None:
    image = torch.rand(1, 1, 9, 11, dtype=torch.float64)
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])
    array = image[0, 0].numpy()
    filtered = np.full(array.shape, np.nan)
    for y in range(1, 8):
        for x in range(1, 10):
            filtered[y, x] = np.abs((mask * array[y - 1 : y + 2, x - 1 : x + 2]).sum())
    for radius in (1, 3):
        found = estimated_variance(image, radius)[0, 0].numpy()
        for y, x in ((0, 0), (0, 10), (4, 5), (8, 3), (8, 10)):
            box = filtered[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            assert found[y, x] == pytest.approx(np.pi / 2 * (np.nanmean(box) / 6) ** 2, rel=1e-12)


def test_variances_look_no_farther_than_stated() -> None:
    hows: tuple[Noise, ...] = ("measured", "halves", "variance", "estimated", "none")
    for how in hows:
        whole = buffers(21, 21)
        plain = halves.halves(whole, "color", how, 2).variance
        for step, name in enumerate(halves.inputs("color", how), 1):
            whole[name] = whole[name].clone()
            whole[name][..., 10, 10] += step
        changed = (halves.halves(whole, "color", how, 2).variance != plain)[0, 0].nonzero()
        reach = int((changed - 10).abs().max()) if len(changed) else 0
        assert reach == halves.reach(how, 2)


@pytest.mark.parametrize(
    ("how", "available", "other", "reason"),
    [
        ("measured", {"color_a", "color_b"}, "halves", "no color_variance: the difference of the halves"),
        ("measured", {"color", "color_variance"}, "variance", "no color_a and no color_b: color, the mean,"),
        ("halves", {"color", "color_variance", "color_a"}, "variance", "no color_b: color, the mean,"),
        ("variance", {"color", "color_a", "color_b"}, "halves", "no color_variance: the difference"),
        ("measured", {"color"}, None, ""),
        ("estimated", {"color_a", "color_b"}, None, ""),
        ("measured", set(NAMES), None, ""),
    ],
)
def test_what_stands_in_is_named_with_its_reason(
    how: Noise, available: set[str], other: str | None, reason: str
) -> None:
    found = halves.possible("color", how, available)
    if other is None:
        assert found is None
    else:
        assert found is not None
        assert found[0] == other
        assert found[1].startswith(reason)
        assert set(halves.inputs("color", found[0])) <= available


def test_unknown_words_are_refused() -> None:
    with pytest.raises(ValueError, match=r"NLM: color_noise must be one of measured, .*, got 'guess'"):
        halves.checked("NLM: color_noise", "guess")  # type: ignore[arg-type]
