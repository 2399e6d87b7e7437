"""What LBF reads: filtered feature groups, their statistics, images without spikes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from models.ops.group_nlm import GroupKernel, group_nlm
from models.ops.nlm import Guide
from models.ops.secondary_features import REACH, noise, secondary_features, spread
from models.ops.spikes import mean_and_deviation, median, without_spikes
from tests.models import plain_lbf
from tests.models.classical.test_nlm_forms import DEVICES, as_rows

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

KERNEL = GroupKernel(2, 1, 1)


def image(channels: int, height: int, width: int, batch: int = 1, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, channels, height, width, generator=generator, dtype=torch.float64)


def groups(height: int, width: int, batch: int = 1) -> list[Guide]:
    """Return two groups whose noise is about what their variances say."""
    return [Guide(image(c, height, width, batch, c), 0.3 * image(c, height, width, batch, 7)) for c in (3, 1)]


@pytest.mark.parametrize("size", [(8, 9), (1, 7), (6, 1), (2, 2)])
@pytest.mark.parametrize("device", DEVICES)
def test_every_group_is_filtered_as_the_transcription_does(size: tuple[int, int], device: str) -> None:
    given = groups(*size)
    found = group_nlm([Guide(*(x.to(device) for x in group)) for group in given], KERNEL)
    for group, result in zip(given, found, strict=True):
        expected = plain_lbf.feature_filter(*(as_rows(x) for x in group), (2, 1, 1))
        for part, plain in zip(result, expected, strict=True):
            assert np.abs(as_rows(part.cpu()) - plain).max() < 1e-12


def test_groups_are_filtered_each_by_itself_and_images_of_a_batch_too() -> None:
    given = groups(9, 10, 2)
    together = group_nlm(given, KERNEL)
    for group, result in zip(given, together, strict=True):
        for b in (0, 1):
            alone = group_nlm([Guide(*(x[b : b + 1] for x in group))], KERNEL)[0]
            torch.testing.assert_close(alone.image, result.image[b : b + 1], rtol=1e-14, atol=0)
            torch.testing.assert_close(alone.variance, result.variance[b : b + 1], rtol=1e-14, atol=0)
    assert group_nlm([], KERNEL) == []


def test_strips_of_the_feature_filter_change_nothing() -> None:
    given = groups(40, 6)
    for one, other in zip(group_nlm(given, KERNEL), group_nlm(given, KERNEL, budget=1), strict=True):
        torch.testing.assert_close(one.image, other.image, rtol=1e-14, atol=0)


def test_a_feature_that_is_constant_or_free_of_noise_stays() -> None:
    flat, steps = torch.full((1, 1, 9, 9), 0.7).double(), image(1, 9, 9)
    none = torch.zeros_like(flat)
    kept = group_nlm([Guide(flat, none + 0.1), Guide(steps, none)], GroupKernel(2, 1, 0))
    torch.testing.assert_close(kept[0].image, flat, rtol=1e-14, atol=0)
    torch.testing.assert_close(kept[1].image, steps, rtol=1e-14, atol=0)


@pytest.mark.parametrize("size", [(11, 10), (1, 9), (7, 1)])
def test_statistics_are_those_of_the_transcription(size: tuple[int, int]) -> None:
    filtered = groups(*size)
    unfiltered = [image(3, *size, seed=11), image(1, *size, seed=12)]
    found = as_rows(secondary_features(filtered, unfiltered))
    expected = [
        plain_lbf.statistics(as_rows(f), as_rows(v), as_rows(u))
        for (f, v), u in zip(filtered, unfiltered, strict=True)
    ]
    assert found.shape == (*size, 14)
    assert np.abs(found - np.concatenate(expected, -1)).max() < 1e-12


def test_the_noise_of_white_noise_is_its_deviation_and_ramps_have_none() -> None:
    generator = torch.Generator().manual_seed(2)
    white = 0.2 * torch.randn(1, 1, 80, 80, generator=generator, dtype=torch.float64)
    estimates = noise(white)
    # The dilation keeps the largest of nine estimates.
    assert 0.2 < float(estimates.mean()) < 0.28
    rows, columns = torch.meshgrid(torch.arange(30), torch.arange(30), indexing="ij")
    ramp = (0.3 * rows.double() + 0.1 * columns)[None, None]
    assert noise(ramp)[..., 5:-5, 5:-5].max() < 1e-12


def test_statistics_look_no_further_than_their_reach() -> None:
    given = image(1, 21, 21)
    moved = given.clone()
    moved[..., 10, 10] += 100.0
    changed = (noise(moved) - noise(given))[0, 0].abs() > 0
    rows, columns = changed.nonzero().unbind(1)
    for places in (rows, columns):
        assert int(places.min()) >= 10 - REACH
        assert int(places.max()) <= 10 + REACH


def test_the_spread_of_a_step_is_that_of_its_neighbourhood() -> None:
    step = torch.zeros(1, 1, 5, 6)
    step[..., 3:] = 1.0
    found = spread(step)[0, 0]
    assert float(found[2, 1]) == 0.0
    assert float(found[2, 2]) == pytest.approx(2 * (1 / 3) * (2 / 3))
    assert float(found[0, 2]) == pytest.approx(2 * (1 / 3) * (2 / 3))  # at the border two rows count


@pytest.mark.parametrize("size", [(9, 8), (1, 12), (8, 1)])
def test_spikes_are_replaced_as_the_transcription_does(size: tuple[int, int]) -> None:
    given = image(3, *size)
    given[0, 1, size[0] // 2, size[1] // 2] = 30.0
    expected = plain_lbf.despiked(as_rows(given), 2, 1.8)
    found = as_rows(without_spikes(given, 2, 1.8))
    assert np.abs(found - expected).max() == 0
    assert (expected != as_rows(given)).any(-1).sum() < size[0] * size[1] / 2
    assert expected.max() < 1


def test_a_constant_has_no_spikes_whatever_its_value() -> None:
    for value in (0.0, 0.3, 1e15):
        flat = torch.full((1, 3, 9, 9), value)
        assert torch.equal(without_spikes(flat, 2, 2.0), flat)


def test_one_spiked_channel_takes_the_others_with_it() -> None:
    given = image(3, 9, 9)
    given[0, 0, 4, 4] = 50.0
    found = without_spikes(given, 2, 3.0)
    assert torch.equal(found[..., 4, 4], median(given)[..., 4, 4])
    assert (found[0, 1:, 4, 4] != given[0, 1:, 4, 4]).all()


def test_mean_and_deviation_are_of_what_lies_inside() -> None:
    given = image(1, 6, 5)
    mean, deviation = mean_and_deviation(given, 1)
    corner = given[0, 0, :2, :2]
    torch.testing.assert_close(mean[0, 0, 0, 0], corner.mean())
    torch.testing.assert_close(deviation[0, 0, 0, 0], corner.std(correction=0))


@pytest.mark.parametrize("radii", [(0, 3, 2), (5, -1, 2), (5, 3, -1)])
def test_radii_that_cannot_be_are_refused(radii: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="the filter of features needs a window radius >= 1"):
        GroupKernel(*radii)
