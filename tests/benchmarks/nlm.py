"""Figure 3 of the training-free methods: non-local means, window 21x21, patches 7x7.

One image filtered with weights of its own, with a variance per pixel and one weight for the three channels:
half of what `models.classical.nlm.NLM` does, and as much as one call of scikit-image does. Against
- the formula written down pixel by pixel and patch by patch, compiled by Numba (the harder opponent), of
  which the first rows are computed;
- the same with NumPy, one pixel's window of patches at a time; a few pixels are computed;
- scikit-image's `denoise_nl_means` in its fast mode, which uses integral images and visits each pair of
  pixels once; it has one noise level for the whole image and runs on one thread.
All take float32. The image is made of the sample's stills (`tests.benchmarks.mosaic`). Wall times of the
contestants are taken in turns; the opponents that compute a part count per pixel.

    python -m tests.benchmarks.nlm
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from models.ops.nlm import Guide, PatchKernel, nlm_filter
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.plain_filter import array_filter, plain_filter
from tests.benchmarks.timing import Row, print_table, row

SIDES, THREADS = (256, 512), (1, 2)
KERNEL = PatchKernel(10, 3, (0.45,), channels="mean", epsilon=1e-10)
NAMES = ("color_a", "color_variance")
PLAIN_ROWS, PLAIN_PIXELS = 16, 64
REPEATS = 3
AT_LEAST = {"plain": 5.0, "scikit-image": 1.0}
LIMIT_ERROR = 1e-4


class Cost(NamedTuple):
    """Least wall and processor microseconds per pixel."""

    wall: float
    processor: float


def run() -> list[Row]:
    """Return the rows of figure 3."""
    rows: list[Row] = []
    for side in SIDES:
        rows += side_rows(side)
    return rows


def side_rows(side: int) -> list[Row]:
    """Return the rows of one image size."""
    image, variance = (t[0] for t in mosaic(side, side, NAMES).values())
    variance = 2 * variance  # that of a half
    before = torch.get_num_threads()
    rows: list[Row] = []
    try:
        for threads in THREADS:
            torch.set_num_threads(threads)
            calls, pixels = contestants(image, variance, threads)
            costs = least(calls, pixels)
            rows += cost_rows(f"{side}x{side}, {threads} thread{'s' * (threads > 1)}", costs)
        error = difference(image, variance)
    finally:
        torch.set_num_threads(before)
    name = f"NLM {side}x{side}: compiled against the plain form"
    return [*rows, row(name, error, "", f"<= {LIMIT_ERROR:g}", error <= LIMIT_ERROR)]


def ours(image: Tensor, variance: Tensor, fused: bool) -> Tensor:
    """Filter an image (C, H, W) with its own weights."""
    guide = Guide(image[None], variance[None])
    with torch.inference_mode():
        return nlm_filter(image[None, None], [guide], KERNEL, fused=fused)[0, 0]


def contestants(
    image: Tensor, variance: Tensor, threads: int
) -> tuple[dict[str, Callable[[], object]], dict[str, int]]:
    """Return what runs, and how many pixels each computes."""
    from skimage.restoration import denoise_nl_means

    side = image.shape[-1]
    arrays = image.numpy(), variance.numpy()
    last = np.ascontiguousarray(arrays[0].transpose(1, 2, 0))
    sigma = float(variance.mean() ** 0.5)
    settings: dict[str, Any] = {"patch_size": 7, "patch_distance": 10, "h": 0.45 * sigma, "sigma": sigma}
    inner = range(KERNEL.reach, KERNEL.reach + int(PLAIN_PIXELS**0.5))
    calls: dict[str, Callable[[], object]] = {
        "compiled": lambda: ours(image, variance, fused=True),
        "PyTorch": lambda: ours(image, variance, fused=False),
        "plain": lambda: plain_filter(*arrays, KERNEL, PLAIN_ROWS * threads, threads),
    }
    pixels = {"compiled": side**2, "PyTorch": side**2, "plain": PLAIN_ROWS * threads * side}
    if threads == 1:
        calls["plain, NumPy"] = lambda: [array_filter(*arrays, KERNEL, (y, x)) for y in inner for x in inner]
        pixels["plain, NumPy"] = len(inner) ** 2
        calls["scikit-image"] = lambda: denoise_nl_means(last, fast_mode=True, channel_axis=-1, **settings)
        pixels["scikit-image"] = side**2
    return calls, pixels


def least(calls: Mapping[str, Callable[[], object]], pixels: Mapping[str, int]) -> dict[str, Cost]:
    """Return the least costs per pixel over several turns, after one that does not count."""
    found: dict[str, list[Cost]] = {name: [] for name in calls}
    for turn in range(REPEATS + 1):
        for name, call in calls.items():
            wall, processor = time.perf_counter(), time.process_time()
            call()
            wall, processor = time.perf_counter() - wall, time.process_time() - processor
            if turn:
                found[name].append(Cost(wall / pixels[name] * 1e6, processor / pixels[name] * 1e6))
    return {
        n: Cost(min(c.wall for c in costs), min(c.processor for c in costs)) for n, costs in found.items()
    }


def cost_rows(what: str, costs: Mapping[str, Cost]) -> list[Row]:
    """Return costs, and the ratios that have targets."""
    rows: list[Row] = []
    for name, cost in costs.items():
        rows.append(row(f"NLM {what}, {name}: wall time", cost.wall, "us/px"))
        rows.append(row(f"NLM {what}, {name}: processor time", cost.processor, "us/px"))
    for name, target in AT_LEAST.items():
        if name in costs:
            times = costs[name].wall / costs["compiled"].wall
            rows.append(row(f"NLM {what}: {name} / compiled", times, "x", f">= {target:g}x", times >= target))
    rows += [
        row(f"NLM {what}: {name} / compiled", costs[name].wall / costs["compiled"].wall, "x")
        for name in ("PyTorch", "plain, NumPy")
        if name in costs
    ]
    return rows


def difference(image: Tensor, variance: Tensor) -> float:
    """Return the largest difference from the plain forms, relative to the largest value."""
    found = ours(image, variance, fused=True).numpy()
    arrays = image.numpy(), variance.numpy()
    rows = plain_filter(*arrays, KERNEL, PLAIN_ROWS, 1)
    place = (KERNEL.reach, KERNEL.reach + 5)
    pixel = array_filter(*arrays, KERNEL, place)
    errors = (np.abs(rows - found[:, :PLAIN_ROWS]).max(), np.abs(pixel - found[:, *place]).max())
    return float(max(errors) / np.abs(rows).max())


if __name__ == "__main__":
    print_table(run())
