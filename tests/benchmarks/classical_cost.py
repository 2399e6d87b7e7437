"""Figure 1 of the training-free methods together: time and memory per megapixel, growth, and steps.

Every method filters a frame of a quarter of a megapixel and one of a whole, made of the sample's stills
(`tests.benchmarks.mosaic`; for RHF of its frames with samples), in a process of its own on all cores, after a
small frame that loads its code. Times are wall times, the least of up to three calls, of one where a call
takes longer than `LONG` seconds. Growth is the quotient of the times of both frames; the frames' is 4. Memory
is what the process takes at most beside the package and the frame, result included. Steps are shares of
processor time, measured by a clock around the functions that make them; a step does not contain others. SVGF
and BMFR filter the later of some frames of a camera that moves (`tests.benchmarks.sequence_frames`); LBF has
random weights.

What their sharing and their compiled kernels save is in `tests.benchmarks.classical_plain`.

    python -m tests.benchmarks.classical_cost [--only METHOD …]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import models
from models import Denoiser
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.rhf import frame as frame_with_samples
from tests.benchmarks.sequence_frames import sequence
from tests.benchmarks.steps import Clock, Named, clocked
from tests.benchmarks.timing import Row, print_table, row
from trainer.benchmarking.machine import usable_threads
from trainer.benchmarking.memory import reset_peak, status

SIZES = {"0.25": (432, 576), "1": (864, 1152)}
"""Megapixels → rows and columns."""

FEATURES = ("normal", "albedo", "depth")
SMALL, CALLS, LONG, LIMIT_S = 64, 3, 3.0, 300
REST = "everything else"


def _by_size(images: Tensor, *_: Any, **__: Any) -> str:
    return f"scale of {images.shape[-1]} columns"


def _rdfc(images: Tensor, guide: Any, kernel: Any, *_: Any, **__: Any) -> str:
    """Name a filter of RDFC by its window and its patches."""
    if len(kernel.rules) > 1:
        return "candidates"
    names = {5: "features and selection", 1: "errors"}
    return "second pass" if kernel.bandwidth < 1 else names[kernel.window]


@dataclass(frozen=True)
class Method:
    """A denoiser of the table.

    Attributes:
        network: Name of the class in `models`.
        options: Of its constructor.
        steps: See `tests.benchmarks.steps.clocked`.
    """

    network: str
    options: Mapping[str, Any] = field(default_factory=dict)
    steps: Mapping[str, Named] = field(default_factory=dict)


_PREFILTER: Mapping[str, Named] = {
    "models.ops.features.Prefilter.__call__": "features",
    "models.ops.features.Prefilter.halves": "features",
}
_NFOR: Mapping[str, Named] = {
    **_PREFILTER,
    "models.classical.nfor.collaborative_regression": "regressions",
    "models.classical.nfor.filter_frames": "error and selection maps",
}
_WLR: Mapping[str, Named] = {
    "models.ops.local_regression.Stack": "joining",
    "models.ops.fused.estimate": "reduction and trials",
    "models.ops.fused.finish": "final fit",
}
_SEQUENCE: Mapping[str, Named] = {
    "models.classical.sequence_filter.antialiased": "antialiasing",
    "models.classical.sequence_filter.SequenceFilter._finished": "albedo",
}

METHODS: dict[str, Method] = {
    "NLM": Method("NLM", steps={"models.classical.nlm.nlm_filter": "filter"}),
    "multi-scale NLM": Method("MultiScaleNLM", steps={"models.classical.nlm.nlm_filter": _by_size}),
    "joint NLM": Method(
        "JointNLM",
        {"features": FEATURES},
        {**_PREFILTER, "models.classical.joint_nlm.joint_filter": "filter"},
    ),
    "cross bilateral": Method(
        "CrossBilateral", steps={"models.classical.cross_bilateral.CrossBilateral._smoothed": "guide"}
    ),
    "joint bilateral": Method(
        "JointBilateral",
        {"temporal": False},
        {"models.classical.joint_bilateral.JointBilateral._features": "features"},
    ),
    "NFOR public": Method("NFOR", {"features": FEATURES}, _NFOR),
    "NFOR paper": Method("NFOR", {"features": FEATURES, "preset": "paper"}, _NFOR),
    "RDFC": Method("RDFC", steps={"models.classical.rdfc.pair_filter": _rdfc}),
    "RHF": Method(
        "RHF",
        steps={
            "models.ops.histogram_distance.HistogramPatches.accepted": "distances",
            "models.classical.rhf.histogram_filter": "averages",
        },
    ),
    "WLR": Method("WLR", {"features": FEATURES}, _WLR),
    "WLR-PF": Method("WLR", {"features": FEATURES, "prefilter": True}, {**_PREFILTER, **_WLR}),
    "LBF": Method(
        "LBF",
        {"features": FEATURES},
        {
            "models.lbf.group_nlm": "features",
            "models.ops.secondary_features.secondary_features": "statistics",
            "models.lbf.scaled_bilateral": "filter",
            "models.lbf.without_spikes": "spikes",
        },
    ),
    "SVGF": Method(
        "SVGF",
        steps={
            **_SEQUENCE,
            "models.classical.svgf.SVGF._accumulated": "accumulation",
            "models.classical.svgf.SVGF._with_variance": "variance of young pixels",
            "models.classical.svgf.SVGF._filtered": "a-trous iterations",
        },
    ),
    "BMFR": Method(
        "BMFR",
        steps={
            **_SEQUENCE,
            "models.classical.bmfr.BMFR._same_surface": "comparison with the frame before",
            "models.classical.bmfr.BMFR._accumulated": "accumulation",
            "models.ops.block_regression.BlockRegression.__call__": "regression",
        },
    ),
}
"""Name in the table → method. Another one is one line."""


def run(names: Sequence[str] = tuple(METHODS)) -> list[Row]:
    """Return the rows of all methods, or of some."""
    rows: list[Row] = []
    for name in names:
        found = {size: measured(name, size) for size in SIZES}
        rows += method_rows(name, found)
    return rows


def measured(name: str, size: str) -> dict[str, Any] | None:
    """Return what `measure` finds in a process of its own, None where that takes longer than `LIMIT_S`."""
    command = [sys.executable, "-m", "tests.benchmarks.classical_cost", "--child", name, size]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return None
    if done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stderr.strip()[-500:]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def method_rows(name: str, found: Mapping[str, dict[str, Any] | None]) -> list[Row]:
    """Return the rows of one method: of each size, then the growth and the steps of the larger."""
    rows, each = [], {}
    for size, costs in found.items():
        what = f"{name}, {size} MP"
        if costs is None:
            rows.append(row(f"{what}: stopped, longer than", float(LIMIT_S), "s"))
            continue
        megapixels = costs["pixels"] / 1e6
        each[size] = min(costs["times"])
        rows += [
            row(f"{what}: time", each[size] / megapixels, "s/MP", f"least of {len(costs['times'])}"),
            row(f"{what}: processor time", costs["processor"] / megapixels, "s/MP"),
            row(f"{what}: memory beside the frame", costs["memory"] / 1e6 / megapixels, "MB/MP"),
        ]
    last = list(found.values())[-1]
    if len(each) < len(found) or last is None:
        return rows
    first, *_, largest = each.values()
    rows.append(row(f"{name}: growth of the time", largest / first, "x"))
    total = last["processor"]
    shares = {**last["steps"], REST: total - sum(last["steps"].values())}
    return [*rows, *(row(f"{name}, share of {step}", 100 * s / total, "%") for step, s in shares.items())]


def measure(name: str, size: str) -> dict[str, Any]:
    """Measure a method on a frame, in this process."""
    torch.set_num_threads(usable_threads())
    method = METHODS[name]
    net: Denoiser = getattr(models, method.network)(**method.options).eval()
    height, width = SIZES[size]
    with torch.inference_mode():
        _filter(net, _frames(net, SMALL, SMALL), clocks=False, steps={})
        frames = _frames(net, height, width)
        before = reset_peak()
        wall, processor, clock = _filter(net, frames, clocks=True, steps=method.steps)
        memory, times = status("VmHWM") - before, [wall]
        while len(times) < CALLS and wall < LONG:
            times.append(_filter(net, frames, clocks=False, steps={})[0])
    return {
        "times": times,
        "processor": processor,
        "memory": memory,
        "steps": clock.seconds,
        "pixels": height * width,
    }


def _filter(
    net: Denoiser, frames: Sequence[Mapping[str, Tensor]], clocks: bool, steps: Mapping[str, Named]
) -> tuple[float, float, Clock]:
    """Filter a frame after those before it; returns wall and processor seconds of the last, and its steps."""
    state = None
    *past, last = frames
    for frame in past:
        state = net(frame, state).state
    given = (last, state) if net.recurrent else (last,)
    with clocked(steps if clocks else {}) as clock:
        wall, processor = time.perf_counter(), time.process_time()
        net(*given)
        return time.perf_counter() - wall, time.process_time() - processor, clock


def _frames(net: Denoiser, height: int, width: int) -> list[dict[str, Tensor]]:
    """Return the frames that a method reads: one, or as many as bring it to its usual state."""
    if net.recurrent:
        return sequence(height, width, net.inputs, 6)
    if "histogram" not in net.inputs:
        return [mosaic(height, width, net.inputs)]
    color, histogram = frame_with_samples()
    times = -(-max(height, width) // color.shape[-1])
    images = (x.tile(1, 1, times, times)[..., :height, :width] for x in (color, histogram))
    return [dict(zip(("color", "histogram"), (x.contiguous() for x in images), strict=True))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=METHODS, default=tuple(METHODS), metavar="METHOD")
    parser.add_argument("--child", nargs=2, metavar=("METHOD", "SIZE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(*options.child)))
    else:
        print_table(run(options.only))
