"""SVGF and BMFR on 1280x720 frames: time per frame, and what the machine's memory and arithmetic allow.

A camera moves (`tests.benchmarks.sequence_frames`); the frames after the first `START` are timed, each with
the state of the one before, in a process of its own on all cores. The limits, measured in the same process:

- bandwidth: the bytes that a frame must move, divided by how fast a copy of `COPIED` bytes moves what it
  reads and writes. Counted are every buffer of the frame and of the state before, read once; the state and
  the result, written once; and what one pass over the image leaves for the next, which reads it at a
  distance: an image written and read. SVGF has seven such passes (accumulation, variance, five iterations;
  colour and variance), of which all but one read normal and depth again. BMFR has three (accumulation,
  regression, accumulation; colour), of which one reads normal and position again;
- arithmetic: multiply-adds of the formulas, as counted below, divided by the best rate of
  `tests.benchmarks.arithmetic`.

    python -m tests.benchmarks.frame_limit
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from typing import Any

import torch
from torch import Tensor

import models
from models.classical.sequence_filter import SequenceFilter
from models.denoiser import Buffers
from models.ops.block_regression import FEATURES
from tests.benchmarks import arithmetic
from tests.benchmarks.sequence_frames import sequence
from tests.benchmarks.timing import Row, print_table, row
from trainer.benchmarking.machine import usable_threads

SIZE, FRAMES, START, SMALL = (720, 1280), 8, 4, 64
COPIED, COPIES = 256_000_000, 7
PASSED = {"SVGF": 2 * 7 * 4 + 5 * 4, "BMFR": 2 * 3 * 3 + 6}
"""Numbers per pixel that passes move beside buffers, states and result."""

_TAP = 3 + 7 + 2 + arithmetic.EXPONENTIAL // 2 + 5
"""Of SVGF, per tap, in multiply-adds: product of normals, its power, both differences, the exponential, and
weight, colour and variance that are added."""

_RECTIFIED = 40
"""Of the antialiasing: two powers of three channels, a mean of four neighbours, bounds."""

MULTIPLY_ADDS = {
    # 49 taps around young pixels, of which any makes all wait, are counted for none.
    "SVGF": 5 * 24 * _TAP + 13 * 8 + _RECTIFIED,
    # Normal equations of ten features and three colours, their product with the features, two accumulations.
    "BMFR": FEATURES * (FEATURES + 1) // 2 + 3 * FEATURES + 3 * FEATURES + 2 * 4 * 6 + _RECTIFIED,
}
"""Per pixel."""


def run() -> list[Row]:
    """Return times, limits, and the share of the larger limit that is reached."""
    rows: list[Row] = []
    for name in PASSED:
        command = [sys.executable, "-m", "tests.benchmarks.frame_limit", "--child", name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{name}: {done.stderr.strip()[-500:]}")
        rows += frame_rows(name, json.loads(done.stdout.splitlines()[-1]))
    return rows


def frame_rows(name: str, found: dict[str, Any]) -> list[Row]:
    """Return the rows of one method."""
    what = f"{name} {SIZE[1]}x{SIZE[0]}, {found['threads']} threads"
    moved = found["bytes"] / found["bandwidth"]
    computed = 2 * MULTIPLY_ADDS[name] * SIZE[0] * SIZE[1] / found["peak"]
    limit = max(moved, computed)
    rows = [
        row(f"{what}: time per frame", 1e3 * found["seconds"], "ms"),
        row(f"{what}: bytes that must move", found["bytes"] / 1e6, "MB"),
        row(f"{what}: measured bandwidth of a copy", found["bandwidth"] / 1e9, "GB/s"),
        row(f"{what}: limit of the bandwidth", 1e3 * moved, "ms"),
        row(f"{what}: multiply-adds per pixel", float(MULTIPLY_ADDS[name]), ""),
        row(f"{what}: measured arithmetic", found["peak"] / 1e9, "GFLOP/s"),
        row(f"{what}: limit of the arithmetic", 1e3 * computed, "ms"),
        row(f"{what}: share of the larger limit", 100 * limit / found["seconds"], "%"),
    ]
    if found["plain_seconds"] is not None:
        times = found["plain_seconds"] / found["seconds"]
        rows.append(row(f"{what}: without compiled kernels / with them", times, "x"))
    return rows


def measure(name: str) -> dict[str, Any]:
    """Measure a method in this process."""
    threads = usable_threads()
    torch.set_num_threads(threads)
    network: SequenceFilter = getattr(models, name)().eval()
    frames = sequence(*SIZE, network.inputs, FRAMES)
    plain = models.SVGF(fused=False).eval() if name == "SVGF" else None
    with torch.inference_mode():
        for net in (network, *([plain] if plain else [])):
            timed(net, sequence(SMALL, SMALL, net.inputs, 2), 0)  # loads its code
        seconds, moved = timed(network, frames, START)
        return {
            "threads": threads,
            "seconds": seconds,
            "plain_seconds": timed(plain, frames[: START + 2], START)[0] if plain else None,
            "bytes": moved + 4 * PASSED[name] * SIZE[0] * SIZE[1],
            "bandwidth": bandwidth(),
            "peak": max(arithmetic.peak(threads).values()),
        }


def timed(network: SequenceFilter, frames: list[Buffers], start: int) -> tuple[float, int]:
    """Return the median seconds of frames from `start` on, and bytes of buffers, states and result of one."""
    state, times, moved = None, [], 0
    for frame in frames:
        before, began = state, time.perf_counter()
        result = network(frame, state)
        times.append(time.perf_counter() - began)
        state = result.state
        planes: list[Tensor] = [*frame.values(), *(before or {}).values(), *state.values(), result.color]
        moved = sum(plane.nbytes for plane in planes)
    return statistics.median(times[start:]), moved


def bandwidth() -> float:
    """Return how many bytes a copy of a large array reads and writes in a second, at best."""
    source, target = torch.rand(COPIED // 4), torch.empty(COPIED // 4)
    best = float("inf")
    for _ in range(COPIES):
        began = time.perf_counter()
        target.copy_(source)
        best = min(best, time.perf_counter() - began)
    return 2 * COPIED / best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--child", choices=PASSED, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.child)))
    else:
        print_table(run())
