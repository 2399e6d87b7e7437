"""BMFR is its transcription, and does what the paper says it does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from data.frame import Frame
from data.temporal import accumulate
from models.classical.bmfr import BMFR
from models.denoiser import Denoised
from tests.models.frames import largest_relative
from tests.models.plain_bmfr import Options, bmfr
from tests.models.sequences import damages, image, joined, tensors, walk

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAN = float("nan")
LIMIT = 0.5
"""Squared position limit that tells the board of the sequence from the wall."""

Buffers = dict[str, Tensor]


def run(network: BMFR, frames: list[Buffers]) -> list[Denoised]:
    results, state = [], None
    for buffers in frames:
        results.append(network(buffers, state))
        state = results[-1].state
    return results


def sequence(
    count: int = 3, height: int = 16, width: int = 18, kind: torch.dtype = torch.float64
) -> list[Buffers]:
    return [tensors(buffers, kind) for buffers in walk(count, height, width)]


def at_rest(count: int, height: int = 16, width: int = 18) -> list[Buffers]:
    """A camera that stands still: only the noise differs."""
    first, *others = sequence(count, height, width)
    held = {**first, "motion": torch.zeros_like(first["motion"])}
    return [held, *({**held, "irradiance": other["irradiance"]} for other in others)]


OPTIONS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({}, {}),
    ({"noise": 0.05, "half": True, "taa": False}, {"noise": 0.05, "half": True, "taa": False}),
    ({"scale": "all", "cut": True}, {"always_scale": True, "cut": True}),
    ({"normal_limit_squared": 0.01, "solver": "qr"}, {"normal_limit_squared": 0.01}),
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


def test_noise_goes_down_within_a_frame_and_from_frame_to_frame() -> None:
    frames = at_rest(12, 24, 28)
    clean = torch.stack([f["irradiance"] for f in at_rest(300, 24, 28)]).mean(0) * frames[0]["albedo"]
    errors = [(r.color - clean).square().mean().item() for r in run(BMFR(), frames)]
    noisy = (frames[0]["irradiance"] * frames[0]["albedo"] - clean).square().mean().item()
    assert errors[0] < 0.3 * noisy
    assert errors[-1] < 0.5 * errors[0]


def test_a_state_is_detached_and_needs_nothing_else() -> None:
    frames = sequence(2)
    with torch.enable_grad():
        frames[0]["irradiance"].requires_grad_()
        first = BMFR()(frames[0])
        assert first.color.requires_grad
        assert not any(plane.requires_grad for plane in first.state.values())
    moved = {name: plane.clone() for name, plane in first.state.items()}
    network = BMFR()
    assert torch.equal(network(frames[1], moved).color, network(frames[1], first.state).color)


def test_a_frame_of_another_size_or_batch_starts_anew() -> None:
    small, large = sequence(1, 8, 9)[0], sequence(1, 9, 8)[0]
    network = BMFR()
    state = network(small).state
    assert torch.equal(network(large, state).color, network(large).color)
    twice = joined(small, small)
    assert torch.equal(network(twice, state).color, network(twice).color)


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


def test_a_batch_element_never_influences_another() -> None:
    one, other = sequence(3), sequence(3)
    for buffers in other:
        buffers["irradiance"] = 1e6 * buffers["irradiance"].flip(-1)
        buffers["position"] = 50 * buffers["position"]
    separate = run(BMFR(), one)
    together = run(BMFR(), [joined(*pair) for pair in zip(one, other, strict=True)])
    for apart, both in zip(separate, together, strict=True):
        torch.testing.assert_close(both.color[:1], apart.color, rtol=1e-9, atol=1e-12)


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


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (33, 65)])
def test_images_of_any_size_are_filtered(size: tuple[int, int]) -> None:
    for result in run(BMFR(), sequence(3, *size, kind=torch.float32)):
        assert result.color.shape == (1, 3, *size)
        assert result.color.isfinite().all()


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("damage", damages())
def test_a_damaged_frame_stays_finite_and_so_do_those_after_it(
    damage: str, kind: torch.dtype, half: bool
) -> None:
    good = sequence(4, kind=torch.float32)
    frames = [good[0], damages()[damage](good[1]), good[2], good[3]]
    with torch.autocast("cpu", torch.bfloat16, enabled=kind == torch.bfloat16):
        results = run(BMFR(half=half), [{name: plane.to(kind) for name, plane in b.items()} for b in frames])
    for result in results:
        assert result.color.dtype == torch.float32
        assert result.color.isfinite().all()
        assert (result.color >= 0).all()
        assert all(plane.isfinite().all() for plane in result.state.values())


@pytest.mark.parametrize("solver", ["normal", "qr"])
def test_the_noisy_image_has_a_finite_gradient_in_every_frame(solver: Any) -> None:
    first, second = sequence(2, kind=torch.float32)
    network = BMFR(solver=solver)
    state = network(first).state
    second["irradiance"][..., 4:8, :] = 0
    second["irradiance"].requires_grad_()
    with torch.enable_grad():
        network(second, state).color.sum().backward()
    gradient = second["irradiance"].grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0


@pytest.mark.parametrize("name", BMFR.inputs)
def test_a_missing_buffer_is_named_with_the_command_that_makes_it(name: str) -> None:
    (frame,) = sequence(1)
    del frame[name]
    with pytest.raises(ValueError, match=f"missing: {name};.*`trainer render sequences` writes all"):
        BMFR()(frame)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noisy_alpha": 0.0}, "noisy_alpha must be above 0 and at most 1"),
        ({"filtered_alpha": NAN}, "filtered_alpha must be above 0 and at most 1"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"longest": 0}, "longest must be positive"),
        ({"position_limit_squared": 0.0}, "position_limit_squared must be positive"),
        ({"normal_limit_squared": -1.0}, "normal_limit_squared must be positive"),
        ({"scale": "none"}, "scale must be large or all"),
        ({"solver": "lu"}, "solver must be normal or qr"),
    ],
    ids=str,
)
def test_options_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"BMFR: {message}"):
        BMFR(**arguments)


def test_it_is_recurrent_and_never_tiled() -> None:
    assert BMFR.recurrent
    assert BMFR.whole
    assert not BMFR().temporal  # its input is not accumulated: it does that itself
