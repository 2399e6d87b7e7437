"""The benchmark of real-time denoisers: what it calls prediction, what it compares, and that it runs."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from models.nbgd import GRIDS, NBGD
from tests.benchmarks.realtime import BASE, METHODS, Cost, Timed, multiply_adds, network, run, table_rows
from tests.benchmarks.realtime_growth import SIZES, filter_rows, grids_filtered
from tests.models.frames import largest_relative, random_buffers

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

FILTERS = {
    "WSKP": ("models.wskp.reconstruct", 1),
    "MultiResolutionWSKP": ("models.wskp_mr.reconstruct", 3),
    "KP": ("models.kp.gather_inside_rows", 1),
    "MRKP": ("models.mrkp.gather_inside", 3),
    "NBGD": ("models.nbgd.slice_grid", 3),
}
"""Network → its filter, and how often a small frame calls it. RAE has none."""

PAPER_RATIOS = {"KP": 2.16, "MR-KP": 1.92, "NBGD, 2 layers": 1.08, "WSKP, 3 layers": 0.51}


@pytest.mark.parametrize("name", METHODS)
def test_convolutions_count_as_prediction_and_filters_as_reconstruction(name, monkeypatch):
    clock, method = [0.0], METHODS[name]

    def taking(seconds: float, function: Callable[..., Any]) -> Callable[..., Any]:
        def taken(*arguments: Any, **options: Any) -> Any:
            clock[0] += seconds
            return function(*arguments, **options)

        return taken

    buffers = random_buffers(1, 32, 48)
    expected = network(method)(buffers).color
    timed = Timed(method, lambda: clock[0])
    calls = 0
    if method.network in FILTERS:
        path, calls = FILTERS[method.network]
        place, _, attribute = path.rpartition(".")
        function = getattr(importlib.import_module(place), attribute)
        monkeypatch.setattr(path, taking(1000.0, function))
    monkeypatch.setattr(nn.functional, "conv2d", taking(1.0, nn.functional.conv2d))
    assert torch.equal(timed(buffers), expected)
    convolutions = sum(isinstance(module, nn.Conv2d) for module in timed.net.modules())
    assert timed.parts == [(convolutions, 1000.0 * calls)]


def test_filter_with_all_grids_is_that_of_nbgd():
    net, buffers = NBGD().eval(), random_buffers(1, 32, 48)
    guides = net.predict(buffers)
    filtered = grids_filtered(buffers["irradiance"], guides.levels, guides.blend, len(GRIDS))
    assert largest_relative(filtered.clamp_min(0) * buffers["albedo"], net(buffers).color) < 1e-6


def test_quotients_stand_beside_those_of_the_paper():
    found = {name: Cost(2.0 + index, 1.0, 1.0, 10 + index, 1.0) for index, name in enumerate(METHODS)}
    rows = {entry["name"]: entry for entry in table_rows(found)}
    for name, ratio in PAPER_RATIOS.items():
        entry = rows[f"total, {name} / {BASE}"]
        assert entry["value"] == found[name].total / 2.0
        assert (entry["target"], entry["meets"]) == (f"paper {ratio:.2f}", None)
    assert rows["RAE: total"]["value"] == 1e3 * found["RAE"].total
    assert "RAE: reconstruction" not in rows


def test_growth_is_that_of_one_more_grid_or_kernel():
    times = {f"{count} grid{'s' * (count > 1)}": 0.5 + 0.25 * count for count in range(1, len(GRIDS) + 1)}
    times |= {f"{count} kernel{'s' * (count > 1)}": 0.125 * count for count in range(1, len(SIZES) + 1)}
    rows = {entry["name"]: entry for entry in filter_rows({**times, "kernel of 9": 0.25})}
    assert rows["filter, one more grid"]["value"] == 250
    assert rows["filter, one more kernel"]["value"] == 125
    assert rows["filter, 1 grid / kernel of 9"]["value"] == 3
    assert rows["filter, 3 grids / 6 kernels"]["target"] == "paper 4.86"


def test_multiply_adds_are_the_weights_of_a_chain_of_convolutions_without_biases():
    assert [multiply_adds(network(METHODS[name])) for name in (BASE, "KP")] == [27300, 82250]


def test_small_frame_is_measured_with_memory_that_holds_the_result():
    rows = {entry["name"]: entry["value"] for entry in run(128, 128, 1, (BASE,), count=1)}
    assert all(math.isfinite(value) for value in rows.values())
    assert all(value > 0 for name, value in rows.items() if "one more" not in name)
    assert rows[f"{BASE}: memory"] > 3 * 4 * 128**2 / 1e6
    assert {f"total, {BASE} / {BASE}", f"WSKP, {len(SIZES)} kernels", "filter, 2 grids"} <= set(rows)
