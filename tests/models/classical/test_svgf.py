"""SVGF is its transcription, and does what the paper says it does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from models.classical.svgf import SVGF, _Past
from models.ops.atrous import Surfaces
from tests.models.frames import largest_relative
from tests.models.plain_svgf import Options, svgf
from tests.models.sequences import at_rest, image, run, sequence, tensors, walk

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAN = float("nan")


OPTIONS: list[tuple[dict[str, Any], Options]] = [
    ({"iterations": 2, "feedback": 2, "alpha": 0.05}, Options(iterations=2, feedback=2, alpha=0.05)),
    ({"iterations": 1, "feedback": 0, "slope": "along"}, Options(iterations=1, feedback=0, along=True)),
    ({"iterations": 2, "prefilter": False, "sigma_l": 10.0}, Options(2, prefilter=False, sigma_l=10.0)),
    ({"iterations": 1, "margin": 1, "taa": False}, Options(iterations=1, margin=1, taa=False)),
    ({"iterations": 1, "young_radius": 1}, Options(iterations=1, young_radius=1)),
    (
        {"iterations": 1, "depth_floor": 0.2, "moments_alpha": 0.5},
        Options(1, depth_floor=0.2, moments_alpha=0.5),
    ),
    (
        {
            "iterations": 1,
            "geometry": "position",
            "position_limit_squared": 0.02,
            "sigma_z": 0.3,
            "sigma_n": 8.0,
        },
        Options(1, position_limit_squared=0.02, sigma_z=0.3, sigma_n=8.0),
    ),
]


def assert_equals_transcription(arguments: dict[str, Any], options: Options, frames: list[Any]) -> None:
    expected = svgf(frames, options)
    found = run(SVGF(**arguments, aux=True), [tensors(buffers) for buffers in frames])
    for result, truth in zip(found, expected, strict=True):
        assert result.aux is not None
        np.testing.assert_allclose(image(result.color), truth["color"], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(image(result.aux["history"]), truth["count"], rtol=1e-9)
        np.testing.assert_allclose(image(result.aux["variance"]), truth["variance"], rtol=1e-6, atol=1e-12)


def test_with_its_defaults_it_is_its_transcription() -> None:
    assert_equals_transcription({}, Options(), walk(6, 9, 11))


@pytest.mark.parametrize(
    ("arguments", "options"), OPTIONS, ids=lambda x: "-".join(x) if isinstance(x, dict) else ""
)
def test_with_options_it_is_its_transcription(arguments: dict[str, Any], options: Options) -> None:
    assert_equals_transcription(arguments, options, walk(4, 8, 9))


def test_the_sequence_of_these_tests_has_old_and_young_and_new_pixels() -> None:
    counts = svgf(walk(6, 9, 11), Options(0, 0))[-1]["count"]
    assert (counts == 1).mean() > 0.05
    assert ((counts > 1) & (counts < 4)).mean() > 0.2
    assert (counts >= 4).mean() > 0.4


def test_float32_differs_by_rounding() -> None:
    network = SVGF()
    expected = run(network, sequence())
    for found, truth in zip(run(network, sequence(kind=torch.float32)), expected, strict=True):
        assert found.color.dtype == torch.float32
        assert largest_relative(found.color, truth.color) < 1e-3


def test_without_iterations_a_camera_at_rest_makes_the_mean_of_five_frames_and_then_forgets() -> None:
    frames = at_rest(8)
    network = SVGF(0, 0, prefilter=False, taa=False)
    light = [buffers["irradiance"] for buffers in frames]
    mean = light[0]
    for i, result in enumerate(run(network, frames)):
        mean = torch.stack(light[: i + 1]).mean(0) if i < 5 else 0.2 * light[i] + 0.8 * mean
        torch.testing.assert_close(result.color, mean * frames[0]["albedo"])
        assert (result.state["count"] == i + 1).all()


def test_the_number_of_frames_stops_at_32() -> None:
    frames = at_rest(2, 3, 3) * 20
    network = SVGF(0, 0)
    states = [result.state for result in run(network, frames)]
    assert (states[31]["count"] == 32).all()
    assert (states[39]["count"] == 32).all()


def test_the_rounding_of_a_number_of_frames_makes_no_pixel_young() -> None:
    (frame,) = sequence(1)
    network = SVGF()
    surfaces = Surfaces(frame["normal"], frame["depth"], 8, network.stops)
    light, moments = frame["irradiance"], torch.ones_like(frame["motion"])
    for frames, kept in ((4.0 - 2e-7, True), (3.9, False)):
        now = _Past(light, moments, torch.full_like(frame["depth"], frames))
        assert torch.equal(network._with_variance(now, surfaces)[0], light) == kept


def test_the_variance_of_old_pixels_is_that_of_their_own_luminance_over_time() -> None:
    frames = at_rest(4)
    network = SVGF(alpha=0.01, moments_alpha=0.01, aux=True)
    weights = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)[:, None, None]
    grey = torch.stack([(buffers["irradiance"] * weights).sum(1) for buffers in frames])
    found = run(network, frames)[-1].aux
    assert found is not None
    torch.testing.assert_close(found["variance"][:, 0], grey.var(0, unbiased=False))


@pytest.mark.parametrize("slope", ["steepest", "along"])
def test_constant_irradiance_stays_constant_on_every_frame(slope: str) -> None:
    frames = [{**b, "irradiance": torch.full_like(b["irradiance"], 0.7)} for b in sequence(4)]
    for result, buffers in zip(run(SVGF(slope=slope, taa=False), frames), frames, strict=True):  # type: ignore[arg-type]
        torch.testing.assert_close(result.color, 0.7 * buffers["albedo"], rtol=1e-12, atol=0)


def test_the_history_is_the_image_after_the_feedback_iteration() -> None:
    (frame,) = sequence(1)
    for feedback in (0, 1, 3):
        state = SVGF(4, feedback)(frame).state
        short = SVGF(feedback, feedback, taa=False)(frame)
        torch.testing.assert_close(state["color"] * frame["albedo"], short.color)


def test_a_camera_that_jumps_starts_anew_where_the_motion_leads_out_of_the_image() -> None:
    first, second = sequence(2)
    second["motion"] = torch.full_like(second["motion"], 500.0)
    network = SVGF()
    assert torch.equal(network(second, network(first).state).color, network(second).color)


@pytest.mark.parametrize("geometry", ["depth", "position"])
def test_a_cut_to_another_place_without_known_motion_brings_no_history(geometry: str) -> None:
    first, second = sequence(2)
    second["depth"] = 3 * first["depth"]
    second["position"] = first["position"] + 1000 * (first["depth"] > 0)
    second["motion"] = torch.zeros_like(second["motion"])
    network = SVGF(geometry=geometry)  # type: ignore[arg-type]
    count = network(second, network(first).state).state["count"]
    assert (count[..., 2:, :] == 1).all()
    assert (count[..., :2, :] == 2).all()  # sky is sky wherever the camera stands


def test_positions_know_a_surface_again_that_came_nearer_and_depths_do_not() -> None:
    first = at_rest(1)[0]
    second = {**first, "depth": first["depth"] - 3 * (first["depth"] > 0)}
    found = {}
    for geometry in ("depth", "position"):
        network = SVGF(geometry=geometry, depth_floor=1e-6)  # type: ignore[arg-type]
        found[geometry] = (
            (network(second, network(first).state).state["count"][..., 2:, :] == 2).double().mean().item()
        )
    assert found["depth"] < 0.1
    assert found["position"] == 1


def test_radiance_in_other_units_with_its_exposure_comes_back_in_those_units() -> None:
    frames = sequence(3)
    expected = run(SVGF(), frames)
    scaled = [
        {**buffers, "irradiance": 50 * buffers["irradiance"], "exposure": torch.tensor([1 / 50])}
        for buffers in frames
    ]
    for found, truth in zip(run(SVGF(), scaled), expected, strict=True):
        assert largest_relative(found.color / 50, truth.color) < 1e-5


def test_an_exposure_that_changes_does_not_change_what_is_accumulated() -> None:
    frames = at_rest(4)
    network = SVGF(0, 0, prefilter=False)
    expected = run(network, frames)
    changing = [{**b, "exposure": torch.tensor([4.0**i])} for i, b in enumerate(frames)]
    for found, truth in zip(run(network, changing), expected, strict=True):
        torch.testing.assert_close(found.color, truth.color, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(found.state["moments"], truth.state["moments"], rtol=1e-6, atol=1e-9)


def test_depths_in_other_units_change_nothing() -> None:
    frames = sequence(3)
    scaled = [{**b, "depth": 1000 * b["depth"], "position": 1000 * b["position"]} for b in frames]
    for geometry in ("depth", "position"):
        network = SVGF(geometry=geometry)  # type: ignore[arg-type]
        for found, truth in zip(run(network, scaled), run(network, frames), strict=True):
            torch.testing.assert_close(found.color, truth.color, rtol=1e-9, atol=1e-12)


def test_without_positions_it_offers_to_compare_depths() -> None:
    other = SVGF(3, geometry="position").instead({*SVGF.inputs})
    assert other is not None
    network, (reason,) = other
    assert isinstance(network, SVGF)
    assert (network.geometry, network.iterations) == ("depth", 3)
    assert "no position" in reason
    assert SVGF(geometry="position").instead({*SVGF.inputs, "position"}) is None
    assert SVGF(geometry="position").instead({"irradiance"}) is None
    assert SVGF().instead({*SVGF.inputs}) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"feedback": 6}, "feedback must be an iteration, 0 to 5"),
        ({"iterations": -1, "feedback": 0}, "iterations must be at least 0"),
        ({"alpha": 0.0}, "alpha must be above 0 and at most 1"),
        ({"moments_alpha": 1.5}, "moments_alpha must be above 0 and at most 1"),
        ({"sigma_l": 0.0}, "sigma_l must be above 0"),
        ({"sigma_n": NAN}, "sigma_n must be above 0"),
        ({"position_limit_squared": -1.0}, "position_limit_squared must be above 0"),
        ({"depth_floor": -1.0}, "depth_floor must be at least 0"),
        ({"slope": "flat"}, "slope must be steepest or along"),
        ({"geometry": "mesh"}, "geometry must be depth or position"),
    ],
    ids=lambda x: str(x),
)
def test_options_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"SVGF: {message}"):
        SVGF(**arguments)
