"""Reprojection: where pixels were, which of them count, and what they remember."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from data.frame import Frame
from data.temporal import accumulate
from models.ops.reproject import bilinear, footprint, position_limit, surrounding
from tests.models.sequences import frame, image, tensors, walk

pytestmark = pytest.mark.usefixtures("one_thread")

NAN, INF = float("nan"), float("inf")


def planes(height: int = 5, width: int = 7, channels: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(1, channels, height, width, generator=generator, dtype=torch.float64)


def motion(x: float, y: float, height: int = 5, width: int = 7) -> Tensor:
    return torch.tensor([x, y], dtype=torch.float64)[None, :, None, None].expand(1, 2, height, width)


def test_without_motion_a_pixel_is_its_own_and_only_neighbour() -> None:
    last = planes()
    assert torch.equal(bilinear(motion(0, 0)).mean(last), last)


def test_whole_pixels_of_motion_shift_the_image_and_leave_nothing_beyond_its_border() -> None:
    last = planes()
    found = bilinear(motion(2, -1))
    assert torch.equal(found.mean(last)[..., 1:, :5], last[..., :-1, 2:])
    assert (found.total[..., 1:, :5] == 1).all()
    assert (found.total[..., 0, :] == 0).all()
    assert (found.total[..., 5:] == 0).all()
    assert (found.mean(last)[..., 5:] == 0).all()


def test_a_fraction_of_a_pixel_weighs_four_neighbours_bilinearly() -> None:
    last = planes()
    found = bilinear(motion(0.25, 0.5)).mean(last)
    upper = 0.75 * last[..., :-1, :-1] + 0.25 * last[..., :-1, 1:]
    lower = 0.75 * last[..., 1:, :-1] + 0.25 * last[..., 1:, 1:]
    torch.testing.assert_close(found[..., :-1, :-1], 0.5 * upper + 0.5 * lower)


def test_what_is_left_of_four_neighbours_counts_as_much_as_all() -> None:
    last = planes()
    found = bilinear(motion(0.25, 0))
    torch.testing.assert_close(found.mean(last)[..., 6], last[..., 6])  # its right neighbour is outside
    second = torch.zeros(1, 4, 1, 1, dtype=torch.bool)
    second[:, 1] = True
    torch.testing.assert_close(found.only(second).mean(last)[..., :6], last[..., 1:])


@pytest.mark.parametrize("x", [NAN, INF, -INF, 1e30, -1e30, 3e38, 7.0, -8.0])
def test_motion_out_of_the_image_or_that_is_no_number_leads_nowhere(x: float) -> None:
    for found in (bilinear(motion(x, 0).float()), bilinear(motion(0, x).float())):
        assert (found.total == 0).all()
        assert (found.mean(planes().float()) == 0).all()


def test_around_the_nearest_pixel_all_that_are_inside_count_alike() -> None:
    last = planes()
    found = surrounding(motion(0.6, 0))
    torch.testing.assert_close(found.mean(last)[..., 2, 2], last[..., 1:4, 2:5].mean((-2, -1)))
    torch.testing.assert_close(found.mean(last)[..., 0, 6], last[..., :2, 6:].mean((-2, -1)))
    assert found.total[0, 0, 2, 2] == 9
    assert found.total[0, 0, 0, 6] == 2


def test_a_margin_leaves_out_what_lies_near_the_border() -> None:
    found = bilinear(motion(0, 0))
    inner = found.only(found.away_from_border(1, (5, 7))).total[0, 0]
    assert (inner[1:-1, 1:-1] == 1).all()
    assert inner.sum() == 15


def test_images_of_a_batch_are_looked_up_in_their_own_frame_before() -> None:
    last = torch.cat([planes(), 2 * planes()])
    both = torch.cat([motion(1, 0), motion(0, 1)])
    found = bilinear(both)
    for i, alone in enumerate((motion(1, 0), motion(0, 1))):
        assert torch.equal(found.mean(last)[i : i + 1], bilinear(alone).mean(last[i : i + 1]))


def test_it_is_the_accumulation_of_the_data_package() -> None:
    before, now = walk(2, 14, 18)
    limits = (0.02, 0.5)
    names = ("irradiance", "position", "normal", "motion")
    frames = [
        Frame({name: of[name].astype(np.float32) for name in names}, "walk", i)
        for i, of in enumerate((before, now))
    ]
    _, expected = accumulate(frames, *limits)
    one, other = tensors(before, torch.float32), tensors(now, torch.float32)
    found = bilinear(other["motion"])
    accepted = found.distances(other["position"], one["position"]) < limits[0]
    accepted &= found.distances(other["normal"], one["normal"]) < limits[1]
    found = found.only(accepted)
    kept = expected.buffers["history"] == 2
    assert np.array_equal(image(found.total) > 0, kept)
    assert 0.2 < kept.mean() < 0.95
    mean = np.where(kept, 0.5 * (image(found.mean(one["irradiance"])) + now["irradiance"]), now["irradiance"])
    np.testing.assert_allclose(mean, expected.buffers["irradiance"], rtol=1e-5, atol=1e-6)


def test_the_footprint_of_a_wall_that_faces_the_camera_is_the_width_of_its_pixels() -> None:
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    position = torch.stack([0.5 * columns, 0.5 * rows, torch.full_like(rows, 9.0)])[None]
    torch.testing.assert_close(footprint(position), torch.full((1, 1, 1, 1), 0.5))
    oblique = position * torch.tensor([1.0, 7.0, 1.0])[:, None, None]
    torch.testing.assert_close(footprint(oblique), torch.full((1, 1, 1, 1), 0.5))
    torch.testing.assert_close(footprint(1000 * position), torch.full((1, 1, 1, 1), 500.0))


def test_pixels_that_hit_nothing_do_not_change_the_footprint() -> None:
    found = tensors(frame(0, 0, 20, 24, 0))["position"]
    more_sky = found.clone()
    more_sky[..., 2:8, :] = 0
    ratio = (footprint(more_sky) / footprint(found)).item()
    assert 1.0 <= ratio < 1.3  # what is left is farther away


@pytest.mark.parametrize("shape", [(1, 3, 1, 1), (1, 3, 4, 1), (2, 3, 1, 5)])
def test_the_footprint_of_what_has_no_neighbours_or_hits_nothing_is_1(shape: tuple[int, ...]) -> None:
    assert (footprint(torch.zeros(shape)) == 1).all()
    if shape == (1, 3, 1, 1):
        assert (footprint(torch.ones(shape)) == 1).all()


def test_a_given_limit_stands_and_another_is_six_footprints() -> None:
    position = tensors(frame(0, 0, 9, 9, 0))["position"]
    assert position_limit(position, 0.25) == 0.25
    torch.testing.assert_close(position_limit(position, None), (6 * footprint(position)) ** 2)
