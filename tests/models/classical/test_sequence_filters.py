"""What both filters of sequences promise: how state is carried, and what bad frames do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from models.classical.bmfr import BMFR
from models.classical.sequence_filter import SequenceFilter
from models.classical.svgf import SVGF
from tests.models.sequences import at_rest, damages, joined, run, sequence, tensors, walk

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

FILTERS: dict[str, tuple[type[SequenceFilter], dict[str, Any]]] = {
    "SVGF": (SVGF, {}),
    "SVGF-position": (SVGF, {"geometry": "position", "slope": "along", "prefilter": False}),
    "BMFR": (BMFR, {}),
    "BMFR-code": (BMFR, {"solver": "qr", "half": True, "cut": True}),
}


@pytest.fixture(params=FILTERS)
def network(request: pytest.FixtureRequest) -> SequenceFilter:
    kind, arguments = FILTERS[request.param]
    return kind(**arguments)


def test_it_is_recurrent_never_tiled_and_not_exported(network: SequenceFilter) -> None:
    assert network.recurrent
    assert network.whole
    assert "state" in network.no_export


def test_its_input_is_not_accumulated_since_it_does_that_itself(network: SequenceFilter) -> None:
    assert not network.temporal


def test_noise_goes_down_within_a_frame_and_from_frame_to_frame(network: SequenceFilter) -> None:
    frames = at_rest(12, 24, 28)
    clean = torch.stack([f["irradiance"] for f in at_rest(300, 24, 28)]).mean(0) * frames[0]["albedo"]
    seen = clean < 0.8  # brighter than that, one of them cuts
    errors = [(result.color - clean)[seen].square().mean().item() for result in run(network, frames)]
    noisy = (frames[0]["irradiance"] * frames[0]["albedo"] - clean)[seen].square().mean().item()
    assert errors[0] < 0.3 * noisy
    assert errors[-1] < 0.5 * errors[0]


def surfaces(buffers: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return which surface each pixel shows, (H, W): sky 0, wall 1, board 2."""
    depth = buffers["depth"][0, 0]
    wall = (8 + 0.2 * torch.arange(len(depth), dtype=depth.dtype))[:, None]
    return torch.where(depth == 0, 0, torch.where((depth - wall).abs() < 1e-9, 1, 2))


@pytest.mark.parametrize("step", [0.4, 0.8, 1.6, 3.0])
def test_what_comes_into_view_has_no_history(network: SequenceFilter, step: float) -> None:
    first, second = (tensors(buffers) for buffers in walk(2, 20, 24, step))
    before, now, motion = surfaces(first), surfaces(second), second["motion"][0]
    known = torch.zeros_like(now, dtype=torch.bool)
    for y, x in np.ndindex(*now.shape):  # nothing near where the pixel was shows its surface
        place = x + float(motion[0, y, x])
        near = [(y + j, round(place) + i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        inside = [q for q in near if 0 <= q[0] < now.shape[0] and 0 <= q[1] < now.shape[1]]
        known[y, x] = any(before[q] == now[y, x] for q in inside)
    count = network(second, network(first).state).state["count"][0, 0]
    assert (~known).sum() > 3
    assert (count[~known] == 1).all()
    assert (count[known] == 2).double().mean() > 0.8


def test_a_state_is_detached_and_all_that_is_needed(network: SequenceFilter) -> None:
    frames = sequence(2)
    with torch.enable_grad():
        frames[0]["irradiance"].requires_grad_()
        first = network(frames[0])
        assert first.color.requires_grad
        assert not any(plane.requires_grad for plane in first.state.values())
    copied = {name: plane.clone() for name, plane in first.state.items()}
    expected = network(frames[1], first.state).color
    network(frames[0])
    assert torch.equal(network(frames[1], copied).color, expected)


def test_a_state_is_not_changed_by_its_use(network: SequenceFilter) -> None:
    first, second = sequence(2)
    state = network(first).state
    before = {name: plane.clone() for name, plane in state.items()}
    network(second, state)
    assert all(torch.equal(plane, before[name]) for name, plane in state.items())


def test_every_plane_of_the_state_has_the_batch_first(network: SequenceFilter) -> None:
    for result in run(network, [joined(*[frame] * 3) for frame in sequence(2)]):
        assert {plane.shape[0] for plane in result.state.values()} == {3}


def test_a_frame_of_another_size_or_batch_starts_anew(network: SequenceFilter) -> None:
    small, large = sequence(1, 8, 9)[0], sequence(1, 9, 8)[0]
    state = network(small).state
    assert torch.equal(network(large, state).color, network(large).color)
    twice = joined(small, small)
    assert torch.equal(network(twice, state).color, network(twice).color)


def test_a_batch_element_never_influences_another(network: SequenceFilter) -> None:
    one, other = sequence(3), sequence(3)
    for buffers in other:
        buffers["irradiance"] = 1e6 * buffers["irradiance"].flip(-1)
        buffers["position"] = 50 * buffers["position"]
    separate = run(network, one)
    together = run(network, [joined(*pair) for pair in zip(one, other, strict=True)])
    for apart, both in zip(separate, together, strict=True):
        torch.testing.assert_close(both.color[:1], apart.color, rtol=1e-9, atol=1e-12)


def test_the_state_of_sequences_of_different_length_may_be_joined(network: SequenceFilter) -> None:
    frames = sequence(4)
    young, old = network(frames[2]).state, run(network, frames[:3])[-1].state
    both = network(joined(frames[3], frames[3]), joined(young, old)).color
    for b, state in enumerate((young, old)):
        torch.testing.assert_close(both[b : b + 1], network(frames[3], state).color, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (33, 65)])
def test_images_of_any_size_are_filtered(network: SequenceFilter, size: tuple[int, int]) -> None:
    for result in run(network, sequence(3, *size, kind=torch.float32)):
        assert result.color.shape == (1, 3, *size)
        assert result.color.isfinite().all()


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("damage", damages())
def test_a_damaged_frame_stays_finite_and_so_do_those_after_it(
    network: SequenceFilter, damage: str, kind: torch.dtype
) -> None:
    good = sequence(4, 8, 9, kind=torch.float32)
    frames = [good[0], damages()[damage](good[1]), good[2], good[3]]
    given = [{name: plane.to(kind) for name, plane in buffers.items()} for buffers in frames]
    with torch.autocast("cpu", torch.bfloat16, enabled=kind == torch.bfloat16):
        results = run(network, given)
    for result in results:
        assert result.color.dtype == torch.float32
        assert result.color.isfinite().all()
        assert (result.color >= 0).all()
        assert all(plane.isfinite().all() for plane in result.state.values())


def test_autocast_changes_nothing(network: SequenceFilter) -> None:
    frames = sequence(3, kind=torch.float32)
    expected = run(network, frames)
    with torch.autocast("cpu", torch.bfloat16):
        found = run(network, frames)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.color, other.color)


def test_the_noisy_image_has_a_finite_gradient_in_every_frame(network: SequenceFilter) -> None:
    first, second = sequence(2, kind=torch.float32)
    state = network(first).state
    second["irradiance"][..., 4:8, :] = 0
    second["irradiance"].requires_grad_()
    with torch.enable_grad():
        network(second, state).color.sum().backward()
    gradient = second["irradiance"].grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0


def test_a_missing_buffer_is_named_with_the_command_that_makes_it(network: SequenceFilter) -> None:
    for name in network.inputs:
        (frame,) = sequence(1)
        del frame[name]
        with pytest.raises(ValueError, match=f"missing: {name};.*`trainer render sequences` writes all"):
            network(frame)


def test_for_missing_motion_the_command_that_derives_it_is_named(network: SequenceFilter) -> None:
    (frame,) = sequence(1)
    del frame["motion"]
    with pytest.raises(ValueError, match="`trainer denoise` derives motion for frames with position"):
        network(frame)
    (frame,) = sequence(1)
    del frame["albedo"]
    with pytest.raises(ValueError, match=r"writes all it reads$"):
        network(frame)


def test_a_buffer_of_another_shape_is_named(network: SequenceFilter) -> None:
    (frame,) = sequence(1)
    frame["motion"] = frame["motion"][:, :1]
    with pytest.raises(ValueError, match=r"buffer 'motion' has shape .* expected"):
        network(frame)
