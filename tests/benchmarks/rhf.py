"""Ray histogram fusion at one scale, window 13x13, patches 3x3, against its formula pixel by pixel.

The opponent compares patch by patch, bin by bin, and writes the mean of accepted patches as whole patches; it
is compiled by Numba and computes the first rows only. The image is made of the frames of the sample that keep
their samples apart, continued by their mirror images. Processor times on one thread, taken in turns, so that
other work on the machine changes little.

    python -m tests.benchmarks.rhf
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from data.derive import derive
from data.exr import read_frame
from data.sample import SAMPLES
from models import RHF
from tests.benchmarks.timing import Row, print_table, row

SCENES = ("outdoor-000101", "indoor-000102", "outdoor-000103", "indoor-000104")
ROWS, REPEATS, AT_LEAST, LIMIT_ERROR = 16, 3, 3.0, 1e-4
Array = NDArray[np.float32]
NUMBERS = (6, 1, 0.8, 2)
"""Radii of window and patch, kappa, how many nearest patches are always accepted."""


def run() -> list[Row]:
    """Return the rows of this benchmark."""
    color, histogram = frame()
    side, before = color.shape[-1], torch.get_num_threads()
    calls: dict[str, Callable[[], Array]] = {
        "compiled": lambda: ours(color, histogram, fused=True),
        "PyTorch": lambda: ours(color, histogram, fused=False),
        "plain": lambda: plain_rows(color, histogram, ROWS),
    }
    pixels = {"compiled": side**2, "PyTorch": side**2, "plain": ROWS * side}
    times: dict[str, list[float]] = {name: [] for name in calls}
    torch.set_num_threads(1)
    try:
        for turn in range(REPEATS + 1):
            for name, call in calls.items():
                began = time.process_time()
                call()
                if turn:
                    times[name].append((time.process_time() - began) / pixels[name] * 1e6)
        error = difference(calls)
    finally:
        torch.set_num_threads(before)
    least = {name: min(found) for name, found in times.items()}
    rows = [
        row(f"RHF {side}x{side}, {name}: processor time", found, "us/px") for name, found in least.items()
    ]
    for name, target in (("compiled", AT_LEAST), ("PyTorch", 0.0)):
        ratio = least["plain"] / least[name]
        text, met = (f">= {target:g}x", ratio >= target) if target else ("", None)
        rows.append(row(f"RHF {side}x{side}: plain / {name}", ratio, "x", text, met))
    name = f"RHF {side}x{side}: compiled against the plain form"
    return [*rows, row(name, error, "", f"<= {LIMIT_ERROR:g}", error <= LIMIT_ERROR)]


def frame() -> tuple[Tensor, Tensor]:
    """Return colour and histograms of the sample's frames with samples, (1, C, 256, 256)."""
    found: dict[str, list[Tensor]] = {"color": [], "histogram": []}
    for scene in SCENES:
        buffers = derive(read_frame(SAMPLES["layers"] / scene / "f000.exr"), found).buffers
        for name, images in found.items():
            images.append(torch.from_numpy(np.ascontiguousarray(buffers[name].transpose(2, 0, 1)))[None])
    whole = []
    for images in found.values():
        image = torch.cat([torch.cat(images[:2], -1), torch.cat(images[2:], -1)], -2)
        image = torch.cat([image, image.flip(-1)], -1)
        whole.append(torch.cat([image, image.flip(-2)], -2))
    return whole[0], whole[1]


def ours(color: Tensor, histogram: Tensor, fused: bool) -> Array:
    """Filter at one scale, (3, H, W)."""
    with torch.inference_mode():
        result: Array = RHF(1, fused=fused)({"color": color, "histogram": histogram}).color[0].numpy()
    return result


def plain_rows(color: Tensor, histogram: Tensor, rows: int) -> Array:
    """Filter the first rows pixel by pixel, (3, rows, W); the last ones lack the patches below."""
    image, bins = (np.ascontiguousarray(t[0].permute(1, 2, 0).numpy()) for t in (color, histogram))
    total, number = np.zeros_like(image), np.zeros(image.shape[:2], np.float32)
    _filter(image, bins, rows, NUMBERS, total, number)
    return np.asarray((total[:rows] / number[:rows, :, None]).transpose(2, 0, 1), np.float32)


def difference(calls: dict[str, Callable[[], Array]]) -> float:
    """Return the largest difference from the plain form, relative to the largest value."""
    expected, found = calls["plain"](), calls["compiled"]()
    whole = slice(0, ROWS - NUMBERS[1])
    return float(np.abs(expected[:, whole] - found[:, whole]).max() / np.abs(expected[:, whole]).max())


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _distance(bins: Any, p: Any, q: Any, radius: Any) -> Any:
    total, count = np.float32(0.0), np.float32(0.0)
    for n in range(-radius, radius + 1):
        for m in range(-radius, radius + 1):
            a, b = bins[p[0] + n, p[1] + m], bins[q[0] + n, q[1] + m]
            first, second = np.float32(0.0), np.float32(0.0)
            for i in range(20):
                first += a[i]
                second += b[i]
            if first == 0 or second == 0:
                continue
            for i in range(60):
                both = a[i] + b[i]
                if both > np.float32(1.0):
                    d = second * a[i] - first * b[i]
                    total += d * d / (first * second * both)
                    count += np.float32(1.0)
    return total / (count + np.float32(1e-4))


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _filter(image: Any, bins: Any, rows: Any, numbers: Any, total: Any, number: Any) -> None:
    window, patch, threshold, nearest = numbers
    height, width, _ = image.shape
    side = 2 * window + 1
    distances = np.empty(side * side, np.float32)
    for y in range(rows):
        for x in range(width):
            radius = min(patch, y, x, height - 1 - y, width - 1 - x)
            distances[:] = np.inf
            for v in range(max(radius, y - window), min(height - radius, y + window + 1)):
                for u in range(max(radius, x - window), min(width - radius, x + window + 1)):
                    place = (v - y + window) * side + u - x + window
                    distances[place] = _distance(bins, (y, x), (v, u), radius)
            centre = side * side // 2
            distances[centre] = np.inf
            order = np.argsort(distances)
            for rank in range(nearest):
                if distances[order[rank]] < np.inf:
                    distances[order[rank]] = np.float32(0.0)
            distances[centre] = np.float32(0.0)
            share = np.float32(1.0) / np.float32((distances < threshold).sum())
            for n in range(-radius, radius + 1):
                for m in range(-radius, radius + 1):
                    number[y + n, x + m] += np.float32(1.0)
                    for place in range(side * side):
                        if distances[place] < threshold:
                            v, u = y + place // side - window, x + place % side - window
                            for c in range(3):
                                total[y + n, x + m, c] += share * image[v + n, u + m, c]


if __name__ == "__main__":
    print_table(run())
