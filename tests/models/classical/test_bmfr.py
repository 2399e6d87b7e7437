"""BMFR is its transcription, and does what the paper says it does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from data.frame import Frame
from data.temporal import accumulate
from models.classical.bmfr import BMFR
from tests.models.frames import largest_relative
from tests.models.plain_bmfr import Options, bmfr
from tests.models.sequences import at_rest, image, run, sequence, tensors, walk

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAN = float("nan")
LIMIT = 0.5
"""Squared position limit that tells the board of the sequence from the wall."""


OPTIONS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({}, {}),
    ({"noise": 0.05, "half": True, "taa": False}, {"noise": 0.05, "half": True, "taa": False}),
    ({"scale": "all", "cut": True}, {"always_scale": True, "cut": True}),
    ({"normal_limit_squared": 0.01, "solver": "qr"}, {"normal_limit_squared": 0.01}),
    ({"block": 16}, {"side": 16}),
    ({"block": 48}, {"side": 48}),
]


@pytest.mark.parametrize(("arguments", "options"), OPTIONS, ids=lambda x: "-".join(x))
def test_it_is_its_transcription(arguments: dict[str, Any], options: dict[str, Any]) -> None:
    frames = walk(4, 12, 15)
    expected = bmfr(frames, Options(LIMIT, **options))
    network = BMFR(position_limit_squared=LIMIT, **arguments, aux=True)
    for result, truth in zip(run(network, [tensors(f) for f in frames]), expected, strict=True):
        assert result.aux is not None
        np.testing.assert_allclose(image(result.aux["history"]), truth["count"])
        np.testing.assert_allclose(image(result.state["noisy"]), truth["noisy"], rtol=1e-9)
        np.testing.assert_allclose(image(result.aux["irradiance"]), truth["fitted"], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(image(result.color), truth["color"], rtol=1e-6, atol=1e-8)


def test_the_sequence_of_these_tests_has_new_pixels_and_those_with_some_neighbours_left() -> None:
    counts = bmfr(walk(4, 12, 15), Options(LIMIT))[-1]["count"]
    assert (counts == 1).mean() > 0.1
    assert ((counts > 1) & (counts < 4)).mean() > 0.1
    assert (counts == 4).mean() > 0.3


def test_what_enters_the_regression_is_the_accumulation_of_the_data_package() -> None:
    resting = at_rest(9, 12, 15)
    moving = sequence(2, 12, 15)  # of more frames, counts are rounded here and not there
    for frames in (resting, moving):
        names = ("irradiance", "position", "normal", "motion")
        given = [
            Frame({name: image(f[name]).astype(np.float32) for name in names}, "walk", i)
            for i, f in enumerate(frames)
        ]
        found = run(BMFR(position_limit_squared=LIMIT), frames)
        for result, expected in zip(found, accumulate(given, LIMIT, 1.0), strict=True):
            truth = expected.buffers
            np.testing.assert_allclose(
                image(result.state["noisy"]), truth["irradiance"], rtol=1e-5, atol=1e-6
            )
            np.testing.assert_array_equal(image(result.state["count"]), truth["history"].round())


def test_with_a_camera_at_rest_fits_are_averaged_over_ten_frames_and_then_forgotten() -> None:
    frames = at_rest(12)
    found = run(BMFR(taa=False, aux=True), frames)
    fits = [result.aux["irradiance"] for result in found if result.aux is not None]
    assert len(fits) == 12
    mean = fits[0]
    for i, result in enumerate(found):
        mean = torch.stack(fits[: i + 1]).mean(0) if i < 10 else 0.1 * fits[i] + 0.9 * mean
        torch.testing.assert_close(result.color, mean * frames[0]["albedo"])


def test_the_number_of_frames_stops_at_the_longest() -> None:
    frames = at_rest(2, 3, 3) * 4
    counts = [result.state["count"] for result in run(BMFR(longest=6), frames)]
    assert [int(count.max()) for count in counts] == [1, 2, 3, 4, 5, 6, 6, 6]
    assert BMFR().longest == 255


def test_each_frame_has_blocks_of_its_own_place() -> None:
    frames = [sequence(1, 40, 40)[0]] * 2
    for buffers in frames:
        buffers["motion"] = torch.full_like(buffers["motion"], 1000.0)  # so that nothing is accumulated
    first, second = run(BMFR(), frames)
    assert [int(result.state["frame"]) for result in (first, second)] == [0, 1]
    assert not torch.allclose(first.color, second.color)


def test_constant_irradiance_stays_constant_on_every_frame() -> None:
    frames = [{**b, "irradiance": torch.full_like(b["irradiance"], 0.7)} for b in sequence(4)]
    for result, buffers in zip(run(BMFR(taa=False), frames), frames, strict=True):
        torch.testing.assert_close(result.color, 0.7 * buffers["albedo"], rtol=1e-9, atol=0)


def test_a_cut_to_another_place_without_known_motion_brings_no_history() -> None:
    first, second = sequence(2)
    second["position"] = first["position"] + 1000 * (first["depth"] > 0)
    second["motion"] = torch.zeros_like(second["motion"])
    network = BMFR()
    count = network(second, network(first).state).state["count"]
    assert (count[..., 2:, :] == 1).all()
    assert (count[..., :2, :] == 2).all()  # sky is sky wherever the camera stands


def test_a_camera_that_jumps_shows_the_fit_of_the_new_frame_alone() -> None:
    first, second = sequence(2)
    second["motion"] = torch.full_like(second["motion"], -500.0)
    network = BMFR(aux=True)
    found = network(second, network(first).state)
    assert found.aux is not None
    assert torch.equal(found.state["noisy"], second["irradiance"])
    torch.testing.assert_close(found.color, found.aux["irradiance"] * second["albedo"])


@pytest.mark.parametrize("cut", [False, True])
def test_radiance_in_other_units_with_its_exposure_comes_back_in_those_units(cut: bool) -> None:
    frames = sequence(3)
    expected = run(BMFR(cut=cut), frames)
    scaled = [{**b, "irradiance": 64 * b["irradiance"], "exposure": torch.tensor([1 / 64])} for b in frames]
    for found, truth in zip(run(BMFR(cut=cut), scaled), expected, strict=True):
        assert largest_relative(found.color / 64, truth.color) < 1e-9
        assert (truth.color.max() <= 1 + 1e-12) == cut


def test_an_exposure_that_changes_does_not_change_what_is_accumulated() -> None:
    frames = at_rest(4)
    changing = [{**b, "exposure": torch.tensor([4.0**i])} for i, b in enumerate(frames)]
    for found, truth in zip(run(BMFR(), changing), run(BMFR(), frames), strict=True):
        torch.testing.assert_close(found.color, truth.color, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(found.state["filtered"], truth.state["filtered"], rtol=1e-7, atol=1e-9)


def test_with_all_ranges_scaled_positions_in_other_units_change_nothing() -> None:
    frames = sequence(3)
    scaled = [{**b, "position": 100 * b["position"]} for b in frames]
    network = BMFR(scale="all")
    for found, truth in zip(run(network, scaled), run(network, frames), strict=True):
        torch.testing.assert_close(found.color, truth.color, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noisy_alpha": 0.0}, "noisy_alpha must be above 0 and at most 1"),
        ({"filtered_alpha": NAN}, "filtered_alpha must be above 0 and at most 1"),
        ({"noise": 0.0}, "noise must be above 0"),
        ({"longest": 0}, "longest must be above 0"),
        ({"position_limit_squared": 0.0}, "position_limit_squared must be above 0"),
        ({"normal_limit_squared": -1.0}, "normal_limit_squared must be above 0"),
        ({"scale": "none"}, "scale must be large or all"),
        ({"block": 24}, "block must be a multiple of 16, got 24"),
        ({"solver": "lu"}, "solver must be normal or qr"),
    ],
    ids=str,
)
def test_options_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"BMFR: {message}"):
        BMFR(**arguments)
