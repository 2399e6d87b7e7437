"""The benchmarks of training-free methods: what a clock counts, what the plain forms are, and the rows."""

from __future__ import annotations

import time

import pytest
import torch

from models.ops.boxes import box_sum_valid
from models.ops.nlm import PatchKernel
from models.ops.regression import collaborative_regression
from tests.benchmarks import classical_plain, frame_limit
from tests.benchmarks.classical_cost import METHODS, REST, SIZES, method_rows
from tests.benchmarks.sequence_frames import sequence
from tests.benchmarks.steps import clocked
from tests.models.frames import largest_relative

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")


def inner() -> str:
    return "made"


def outer() -> str:
    return inner()


def test_a_step_does_not_contain_the_steps_inside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    def waiting() -> float:
        now[0] += 1.0
        return now[0]

    monkeypatch.setattr(time, "process_time", waiting)
    before = inner
    with clocked({f"{__name__}.inner": "inner", f"{__name__}.outer": lambda: "outer"}) as clock:
        assert outer() == "made"
        assert outer() == "made"
    assert clock.seconds == {"inner": 2.0, "outer": 4.0}  # the clock itself passes between its four readings
    assert inner is before


@pytest.mark.parametrize("name", METHODS)
def test_every_step_is_a_function_that_exists(name: str) -> None:
    with clocked(METHODS[name].steps) as clock:
        assert clock.seconds == {}


def test_shares_add_up_and_growth_is_the_quotient_of_times() -> None:
    found = {
        size: {
            "times": [4.0 * i, 3.0 * i],
            "processor": 8.0,
            "memory": 5e6,
            "steps": {"a": 2.0},
            "pixels": 10**6,
        }
        for i, size in enumerate(SIZES, 1)
    }
    rows = {entry["name"]: entry["value"] for entry in method_rows("NLM", found)}
    assert rows["NLM, 0.25 MP: time"] == 3
    assert rows["NLM: growth of the time"] == 2
    assert rows["NLM, share of a"] + rows[f"NLM, share of {REST}"] == 100
    stopped = method_rows("NLM", {**found, "1": None})
    assert not any("growth" in entry["name"] for entry in stopped)
    assert any("stopped" in entry["name"] for entry in stopped)


def test_unfolded_sums_are_box_sums() -> None:
    maps = torch.rand(2, 3, 9, 11)
    torch.testing.assert_close(classical_plain.unfolded_sum(maps, 5), box_sum_valid(maps, 5))


def test_the_unfolded_regression_is_the_one_that_streams_over_offsets() -> None:
    sample, _ = classical_plain.half_of_a_still(18)
    kernel = PatchKernel(3, 1, (0.5,), 2.0, "least")
    found = classical_plain.unfolded_regression(sample, kernel)
    expected = collaborative_regression([sample], kernel, fused=False)[0][0]
    assert largest_relative(found, expected) < 1e-4


def test_frames_follow_each_other_and_repeat() -> None:
    first, second = sequence(200, 400, ["irradiance", "motion"], 2)
    assert first["irradiance"].shape == (1, 3, 200, 400)
    assert torch.equal(first["irradiance"][..., :80], first["irradiance"][..., 320:])
    assert not torch.equal(first["irradiance"], second["irradiance"])
    assert second["motion"].abs().max() > 0


def test_the_larger_limit_counts() -> None:
    found = {
        "threads": 2,
        "seconds": 0.5,
        "plain_seconds": 1.0,
        "bytes": 10**9,
        "bandwidth": 1e10,
        "peak": 1e15,
    }
    rows = {entry["name"]: entry["value"] for entry in frame_limit.frame_rows("SVGF", found)}
    what = "SVGF 1280x720, 2 threads"
    assert rows[f"{what}: limit of the bandwidth"] == pytest.approx(100)
    assert rows[f"{what}: share of the larger limit"] == pytest.approx(20)
    assert rows[f"{what}: without compiled kernels / with them"] == 2
