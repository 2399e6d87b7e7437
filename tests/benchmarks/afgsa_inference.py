"""AFGSA, figure 2: one 1280x720 frame on the CPU within `--memory 4GB`, in a process of its own.

The full network with random weights denoises through `models.tiling`, as `trainer denoise` does. Memory is
the peak resident set during the call less the resident set before it (weights and frame are there already).
"Tiled against untiled" compares the two on a smaller frame of an odd size, with the full network: the largest
difference of a pixel relative to its own value plus a hundredth of the mean, so that black is no exception.
The reach is measured with a gradient, on a narrow network of the same depth: how far from an 8x8 core the
farthest pixel lies that its output depends on. Declared and measured must be the same number.

    python -m tests.benchmarks.afgsa_inference
"""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import time
from typing import Any

import torch
from torch import Tensor

from models import AFGSA
from models.tiling import denoise_tiled
from tests.benchmarks.timing import Row, print_table, row
from tests.models.frames import split_buffers
from trainer.benchmarking.memory import reset_peak, status

HEIGHT, WIDTH = 720, 1280
BUDGET = 4 * 10**9
FORMS = ("float32", "bfloat16")


def run() -> list[Row]:
    """Return the rows of figure 2."""
    return [*frame_rows(), *equality_rows(), reach_row()]


def frame_rows() -> list[Row]:
    """Time and memory of a whole frame, in both precisions."""
    rows, times = [], {}
    for form in FORMS:
        command = [sys.executable, "-m", "tests.benchmarks.afgsa_inference", form]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{form}: {done.stderr.strip()[-500:]}")
        found = json.loads(done.stdout.splitlines()[-1])
        name, times[form] = f"{WIDTH}x{HEIGHT}, {form}", found["seconds"]
        fits = found["memory"] <= BUDGET
        rows.append(row(f"{name}: time", found["seconds"], "s"))
        rows.append(row(f"{name}: pixels computed / pixels", found["computed"], ""))
        rows.append(row(f"{name}: peak resident", found["memory"] / 1e9, "GB", f"<= {BUDGET / 1e9:g}", fits))
        rows.append(row(f"{name}: memory per pixel of a tile", found["per_pixel"], "B"))
        rows.append(row(f"{name}: differs from float32, crop", found["error"], ""))
    rows.append(row("1280x720: float32 / bfloat16 time", times["float32"] / times["bfloat16"], "x"))
    return rows


def equality_rows() -> list[Row]:
    """Compare tiles with one call, with the full network."""
    net = _network()
    buffers = _buffers(net, 200, 254)
    with torch.inference_mode():
        whole = net(buffers).color
        error = _relative(denoise_tiled(net, buffers, tile=128), whole)
    return [row("tiled against untiled, 254x200", error, "", "<= 1e-4", error <= 1e-4)]


def reach_row() -> Row:
    """Measure how far the output of a core depends on the input."""
    net = _network(16)
    declared, core = net.halo, 8
    start = math.ceil(declared / 8 + 1) * 8
    side = 2 * start + core
    buffers = _buffers(net, side, side)
    color = buffers["color"].double().requires_grad_()
    double = {name: image.double() for name, image in buffers.items()}
    log = net.double().predict({**double, "color": color})
    inside = slice(start, start + core)
    log[..., inside, inside].sum().backward()
    assert color.grad is not None
    rows = torch.nonzero(color.grad.abs().amax((0, 1, 3))).flatten()
    reach = max(start - int(rows[0]), int(rows[-1]) - (start + core - 1))
    return row("measured reach of an 8x8 core", float(reach), "px", f"= {declared}", reach == declared)


def child(form: str) -> dict[str, Any]:
    """Denoise a frame and measure; runs in its own process."""
    net = _network()
    buffers = _buffers(net, HEIGHT, WIDTH)
    small = {name: image[..., :48, :48].contiguous() for name, image in buffers.items()}
    context = torch.autocast("cpu", torch.bfloat16) if form == "bfloat16" else contextlib.nullcontext()
    sizes: list[tuple[int, int]] = []
    net.register_forward_pre_hook(lambda _, arguments: sizes.append(arguments[0]["color"].shape[-2:]))
    with torch.inference_mode():
        with context:
            net(small)  # threads and code are loaded; the frame's memory is not
            sizes.clear()
            before, began = reset_peak(), time.perf_counter()
            color = denoise_tiled(net, buffers, budget=BUDGET)
            seconds, memory = time.perf_counter() - began, status("VmHWM") - before
        core, halo = 64, -(-net.halo // net.multiple) * net.multiple
        rows, columns = slice(0, core + halo), slice(0, core + halo)
        crop = {name: image[..., rows, columns].contiguous() for name, image in buffers.items()}
        exact = net({**crop, **net.measure(buffers)}).color
    pixels = [height * width for height, width in sizes]
    return {
        "seconds": seconds,
        "memory": memory,
        "per_pixel": memory / max(pixels),
        "computed": sum(pixels) / (HEIGHT * WIDTH),
        "error": _relative(color[..., :core, :core], exact[..., :core, :core]),
    }


def _network(width: int = 256) -> AFGSA:
    torch.manual_seed(0)
    return AFGSA(width=width).eval().requires_grad_(False)


def _buffers(net: AFGSA, height: int, width: int) -> dict[str, Tensor]:
    images = split_buffers(1, height, width)
    return {name: images[name] for name in net.inputs}


def _relative(found: Tensor, expected: Tensor) -> float:
    floor = 0.01 * expected.abs().mean()
    return float(((found - expected).abs() / (expected.abs() + floor)).max())


if __name__ == "__main__":
    torch.set_num_threads(2)
    if len(sys.argv) > 1:
        print(json.dumps(child(sys.argv[1])))
    else:
        print_table(run())
