"""Figure 1 of the training-free methods: what NFOR costs, and where.

One 1280x720 frame, made of the sample's stills (`tests.benchmarks.mosaic`), with normal, albedo and depth, on
two threads. It runs in a process of its own, whose peak memory is counted whole and without what it takes
after loading the package and its compiled kernels on a small image, before the frame is loaded.

Against the authors' public implementation only published times stand: 390-540 processor microseconds per
pixel for 7 features at 400x225, on another machine of this kind. The paper: 223 s and 3.2 GB on a workstation
of its time. The form without compiled kernels (PyTorch) runs on a smaller frame; there both are compared.

    python -m tests.benchmarks.nfor
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import psutil
import torch
from torch import Tensor

from models import NFOR
from models.ops import fused
from tests.benchmarks import arithmetic
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.timing import Row, print_table, row
from tests.models.frames import largest_relative
from trainer.benchmarking.memory import reset_peak, status

SIZE, SMALL, THREADS = (720, 1280), (256, 256), 2
FEATURES = ("normal", "albedo", "depth")
PUBLIC = (390.0, 540.0)
"""Processor microseconds per pixel of the public implementation."""

LIMIT_S, LIMIT_GB, LIMIT_SHARE, LIMIT_ERROR = 60.0, 1.0, 1 / 3, 1e-3
STEPS = ("prefilter", "first regressions", "maps", "final features", "last regression")
FIRST = 4
"""Regressions of the first pass: two halves, two bandwidths."""


def timed_steps(window: int) -> dict[str, float]:
    """Have the compiled kernels add their processor seconds to the returned steps."""
    steps = dict.fromkeys(STEPS, 0.0)
    regressions = 0

    def timed(call: Callable[..., Any], step: Callable[[Any], str]) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            name, began = step((*arguments, *named.values())), time.process_time()
            result = call(*arguments, **named)
            steps[name] += time.process_time() - began
            return result

        return run

    def filtering(arguments: Any) -> str:
        kernel = next(part for part in arguments if isinstance(part, fused.Kernel))
        if kernel.patch == 1 and kernel.window == window:
            return "maps"
        return "final features" if kernel.window == 2 else "prefilter"

    def regression(arguments: Any) -> str:
        nonlocal regressions
        regressions += 1
        return "first regressions" if regressions <= FIRST else "last regression"

    fused.filter_images = timed(fused.filter_images, filtering)
    fused.regress = timed(fused.regress, regression)
    return steps


def measure(height: int, width: int, window: int, features: tuple[str, ...]) -> dict[str, Any]:
    """Denoise one frame in this process; returns seconds, bytes and the steps' processor seconds."""
    torch.set_num_threads(THREADS)
    net = NFOR(features=features, window=window).eval()
    with torch.inference_mode():
        net(mosaic(64, 64, net.inputs))
        before = psutil.Process().memory_info().rss
        frame = mosaic(height, width, net.inputs)
        loaded = reset_peak()
        steps = timed_steps(window)
        wall, processor = time.perf_counter(), time.process_time()
        net(frame)
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
    bytes_ = {"before": before, "loaded": loaded, "peak": status("VmHWM")}
    return {"wall": wall, "processor": processor, "bytes": bytes_, "steps": steps}


def measured(size: tuple[int, int], window: int = 9, features: tuple[str, ...] = FEATURES) -> dict[str, Any]:
    """Return what `measure` finds in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.nfor", "--measure", *map(str, (*size, window))]
    result = subprocess.run([*command, *features], check=True, capture_output=True, text=True)
    return dict(json.loads(result.stdout.splitlines()[-1]))


def run() -> list[Row]:
    """Return the rows of figure 1."""
    found, pixels = measured(SIZE), SIZE[0] * SIZE[1]
    peak = arithmetic.peak(THREADS)
    bytes_ = found["bytes"]
    total, own = bytes_["peak"] / 1e9, (bytes_["peak"] - bytes_["before"]) / 1e9
    each = found["processor"] / pixels * 1e6
    name = f"NFOR {SIZE[1]}x{SIZE[0]}, 7 features"
    return [
        row(f"{name}: time", found["wall"], "s", f"<= {LIMIT_S:g} s", found["wall"] <= LIMIT_S),
        row(f"{name}: peak memory of the process", total, "GB", f"<= {LIMIT_GB:g} GB", total <= LIMIT_GB),
        row(
            f"{name}: peak memory beside the loaded package",
            own,
            "GB",
            f"<= {LIMIT_GB:g} GB",
            own <= LIMIT_GB,
        ),
        row(f"{name}: the frame itself", (bytes_["loaded"] - bytes_["before"]) / 1e9, "GB"),
        row(f"{name}: processor time", each, "us/px"),
        *(
            row(
                f"{name}: part of the public implementation's {public:g} us/px",
                each / public,
                "",
                "<= 1/3",
                each / public <= LIMIT_SHARE,
            )
            for public in PUBLIC
        ),
        *share_rows(found, pixels, peak),
        *pytorch_rows(),
    ]


def share_rows(found: dict[str, Any], pixels: int, peak: dict[str, float]) -> list[Row]:
    """The share of each step in the processor time, and its rate."""
    counts = {
        "prefilter": 2 * arithmetic.nlm(5, 3, 7),
        "first regressions": FIRST * arithmetic.regression(9, 3, 7),
        "maps": arithmetic.nlm(9, 1, 3, 2) + arithmetic.nlm(9, 1, 3),
        "final features": arithmetic.nlm(2, 3, 7),
        "last regression": arithmetic.regression(9, 3, 7),
    }
    steps = found["steps"] | {"everything else": found["processor"] - sum(found["steps"].values())}
    rows = [row(f"share of {name}", value / found["processor"], "") for name, value in steps.items()]
    rows += [row(f"machine, {THREADS} threads: {n}", r / 1e9, "GFLOP/s") for n, r in peak.items()]
    best = max(peak.values())
    for name, count in counts.items():
        rate = count * pixels / found["steps"][name] * THREADS
        rows.append(row(f"rate of {name}", rate / 1e9, "GFLOP/s"))
    rate = sum(counts.values()) * pixels / found["processor"] * THREADS
    return [
        *rows,
        row("arithmetic per pixel", sum(counts.values()) / 1e3, "kFLOP"),
        row("rate of all", rate / 1e9, "GFLOP/s"),
        row("rate of all: share of the machine's best", rate / best, ""),
        row(
            "rate of the regressions: share of the machine's best",
            _regressions(found, counts, pixels) / best,
            "",
        ),
    ]


def _regressions(found: dict[str, Any], counts: dict[str, int], pixels: int) -> float:
    names = ("first regressions", "last regression")
    seconds = sum(found["steps"][name] for name in names)
    return sum(counts[name] for name in names) * pixels / seconds * THREADS


def pytorch_rows() -> list[Row]:
    """The form without compiled kernels against the one with them, on a smaller frame."""
    height, width = SMALL
    frame = mosaic(height, width, NFOR().inputs)
    times: dict[str, float] = {}
    results: dict[str, Tensor] = {}
    with torch.inference_mode():
        for name, net in {"compiled": NFOR(fused=True), "PyTorch": NFOR(fused=False)}.items():
            net({n: image[..., :32, :32] for n, image in frame.items()})
            began = time.process_time()
            results[name] = net(frame).color
            times[name] = (time.process_time() - began) / (height * width) * 1e6
    error = largest_relative(results["compiled"], results["PyTorch"])
    name = f"NFOR {width}x{height}"
    return [
        *(row(f"{name}, {n}: processor time", seconds, "us/px") for n, seconds in times.items()),
        row(f"{name}: processor time, PyTorch / compiled", times["PyTorch"] / times["compiled"], "x"),
        row(f"{name}: compiled against PyTorch", error, "", f"<= {LIMIT_ERROR:g}", error <= LIMIT_ERROR),
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--measure",
        nargs="+",
        metavar="NUMBER",
        help="measure in this process: height width window feature …",
    )
    options = parser.parse_args()
    if options.measure:
        rows_, columns, radius = map(int, options.measure[:3])
        print(json.dumps(measure(rows_, columns, radius, tuple(options.measure[3:]))))
    else:
        print_table(run())
