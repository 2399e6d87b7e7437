"""Steps of long computations and the share of the time they take."""

from __future__ import annotations

import pytest
import torch

from models import NFOR, NLM, WLR
from models.denoiser import Denoiser
from models.pace import Pace, listening, tick
from tests.models.frames import split_buffers


def test_steps_add_up_to_the_same_number_for_every_image() -> None:
    def steps(method: Denoiser, height: int, width: int) -> float:
        found: list[float] = []
        with listening(found.append), torch.inference_mode():
            method(split_buffers(1, height, width))
        return sum(found)

    for fused in (False, True):
        for method in (NLM(2, 1, fused=fused), NFOR(window=2, patch=1, prefilter_window=1, fused=fused)):
            assert steps(method, 16, 16) > 0
            assert steps(method, 40, 23) == pytest.approx(steps(method, 16, 16))
    for memory in (None, 100_000):
        local = WLR((), window=2, color_noise="measured", memory=memory, fused=True)
        assert steps(local, 16, 16) > 0
        assert steps(local, 40, 23) == pytest.approx(steps(local, 16, 16))


def test_a_pace_rises_from_nothing_to_all() -> None:
    def sample() -> None:
        for _ in range(10):
            tick(0.5)

    pace = Pace(sample)
    shares = [pace.share(0.25 * i) for i in range(21)]
    assert shares[0] == 0
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert pace.share(99) == 1


def test_nobody_listens_afterwards() -> None:
    found: list[float] = []
    with listening(found.append):
        tick(1.0)
    tick(1.0)
    assert found == [1.0]


def test_a_computation_without_steps_has_no_pace() -> None:
    assert Pace(lambda: None).share(5) == 0
