"""Figure 2 of the per-sample methods: time, multiply-adds and memory against samples per pixel.

The full networks of Munkberg and Hasselgren 2020 with random weights denoise one 256x256 image, untiled, on
two threads. Times are medians of calls that take turns in one process, so that all suffer alike from whatever
else a machine does. Memory is the peak resident set during a call less the resident set before it (loaded
code, weights and samples are there already), each in a process of its own.

Multiply-adds are those of the published formulas, as in figure 10 of the paper: what a convolution's weights
multiply, on [embedding, context] for every sample, layer or pixel that has a kernel, and for a filter one per
tap and channel, weights counted as a channel. Biases, activations, exponentials and averages are not counted.
"As computed" is what convolutions here multiply, counted while they run: the context's half of a first layer
is computed once for several samples, the sample reducer twice (it is not stored).

The paper's text states no numbers of figure 10, nor its resolution; what it states is checked: PixelGather
does not depend on the number of samples, Layer's cost grows slowly with it, SampleSplat's does not.

    python -m tests.benchmarks.per_sample [--side 256] [--picture FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch.utils.flop_counter import FlopCounterMode

import models
from models.blocks.per_sample import PerSample
from models.layers import SCALES, Layer, Optimized, PixelGather, SampleSplat
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import random_samples
from trainer.benchmarking.memory import reset_peak, status

NETWORKS = ("PixelGather", "SampleSplat", "Layer", "Optimized")
COUNTS = (2, 4, 8, 16, 32)
SIDE, WARM, THREADS = 256, 32, 2
REPEATS = 3
SLOWLY = 1 / 4
"""Layer's cost of one more sample is at most this share of SampleSplat's: the paper's "modest overhead"."""


class Cost(NamedTuple):
    """Seconds, bytes beside the input, multiply-adds of the formulas and those that convolutions run."""

    seconds: float
    memory: float
    formulas: float
    computed: float


Costs = Mapping[str, Mapping[int, Cost]]
"""Network → samples per pixel → cost."""


def per_pixel(net: PerSample, spp: int) -> float:
    """Return the multiply-adds per pixel of the published formulas."""
    side = net.multiple
    with torch.device("meta"), FlopCounterMode(display=False) as counter:
        net.unet(torch.empty(1, net.embedding, side, side))
    total = counter.get_total_flops() / 2 / side**2
    taps = net.kernel_size**2
    if isinstance(net, PixelGather):
        return total + _weights(net.reducer) + _weights(net.generator) + 4 * taps
    if isinstance(net, SampleSplat):
        return total + spp * (_weights(net.reducer) + _weights(net.generator) + 4 * taps)
    assert isinstance(net, Layer)
    total += spp * (_weights(net.reducer) + _weights(net.partitioner))
    generators = list(net.generator) if isinstance(net, Optimized) else [net.generator]  # type: ignore[arg-type]
    assert len(generators) == (SCALES if isinstance(net, Optimized) else 1)
    each = (net.layers * (_weights(part) + 5 * taps) / 4**level for level, part in enumerate(generators))
    return total + sum(each)


def _weights(part: torch.nn.Module) -> int:
    return sum(p.numel() for p in part.parameters() if p.ndim > 1)


def network(name: str) -> PerSample:
    """Return a full network for inference."""
    torch.manual_seed(0)
    made: PerSample = getattr(models, name)().eval().requires_grad_(False)
    return made


def cost(name: str, spp: int, side: int) -> tuple[float, float, float]:
    """Return memory and both counts of multiply-adds of one image; runs in a process of its own."""
    net = network(name)
    samples, small = (random_samples(1, spp, s, s) for s in (side, WARM))
    with torch.inference_mode():
        net({"samples": small})  # threads and code are loaded; the image's memory is not
        with FlopCounterMode(display=False) as counter:
            net({"samples": small})
        before = reset_peak()
        net({"samples": samples})
        memory = status("VmHWM") - before
    return memory, per_pixel(net, spp) * side**2, counter.get_total_flops() / 2 / WARM**2 * side**2


@torch.inference_mode()
def times(side: int) -> list[float]:
    """Return the seconds of all networks with all numbers of samples, in turns; runs in its own process."""
    nets = {name: network(name) for name in NETWORKS}
    samples = random_samples(1, max(COUNTS), side, side)
    calls = {
        f"{name} {spp}": partial(net, {"samples": samples[:, :spp].contiguous()})
        for name, net in nets.items()
        for spp in COUNTS
    }
    return list(medians(calls, dict.fromkeys(calls, REPEATS)).values())


def measured(side: int = SIDE) -> Costs:
    """Measure all networks with all numbers of samples."""
    seconds = iter(_child(side))
    return {name: {spp: Cost(next(seconds), *_child(side, name, spp)) for spp in COUNTS} for name in NETWORKS}


def _child(side: int, *network: str | int) -> list[float]:
    """Return `cost` of a network and a number of samples, or without these all `times`."""
    command = [sys.executable, "-m", "tests.benchmarks.per_sample", "--side", str(side)]
    command += ["--child", *map(str, network)]
    waiting = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}  # as the trainer command has it
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=waiting)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-500:]}")
    found: list[float] = json.loads(done.stdout.splitlines()[-1])
    return found


def rows_of(found: Costs) -> list[Row]:
    """Return the table, and what the paper states of it."""
    rows: list[Row] = []
    for name, costs in found.items():
        for spp, cost in costs.items():
            rows += [
                row(f"{name}, {spp} spp: time", cost.seconds, "s"),
                row(f"{name}, {spp} spp: multiply-adds", cost.formulas / 1e9, "G"),
                row(f"{name}, {spp} spp: multiply-adds as computed", cost.computed / 1e9, "G"),
                row(f"{name}, {spp} spp: memory", cost.memory / 1e6, "MB"),
            ]
    return rows + statements(found)


def statements(found: Costs) -> list[Row]:
    """Check how costs grow from the fewest to the most samples."""
    few, many = COUNTS[0], COUNTS[-1]
    rows: list[Row] = []
    for label, key in (("multiply-adds", "formulas"), ("time", "seconds"), ("memory", "memory")):
        at = {name: [getattr(costs[spp], key) for spp in (few, many)] for name, costs in found.items()}
        rows += [
            row(f"{name}: {label} of {many} / {few} spp", ends[1] / ends[0], "x") for name, ends in at.items()
        ]
        if label == "memory":
            continue
        extra = {name: (ends[1] - ends[0]) / (many - few) for name, ends in at.items()}
        share = extra["Layer"] / extra["SampleSplat"]
        name = f"one more sample: {label}, Layer / SampleSplat"
        rows.append(row(name, share, "", f"<= {SLOWLY:.2f}", share <= SLOWLY))
        ratio = at["Layer"][1] / at["SampleSplat"][1]
        rows.append(row(f"{many} spp: {label}, Layer / SampleSplat", ratio, ""))
    still = found["PixelGather"]
    same = still[few].formulas == still[many].formulas
    rows.append(row("PixelGather: multiply-adds differ with spp", float(not same), "", "= 0", same))
    return rows


def picture(found: Costs, path: Path) -> None:
    """Draw costs over samples per pixel."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = (
        ("multiply-adds, billions", "formulas", 1e9),
        ("time on two cores, s", "seconds", 1.0),
        ("memory beside the input, MB", "memory", 1e6),
    )
    figure, axes = plt.subplots(1, len(panels), figsize=(10.5, 3.6))
    for panel, (label, key, unit) in zip(axes, panels, strict=True):
        for name, costs in found.items():
            panel.plot(
                list(costs), [getattr(c, key) / unit for c in costs.values()], marker="o", ms=4, label=name
            )
        panel.set_ylim(bottom=0)
        panel.set_xticks(COUNTS)
        panel.set_xlabel("samples per pixel")
        panel.set_title(label, fontsize=10)
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(target: Path | None = None, side: int = SIDE) -> list[Row]:
    """Return the rows of figure 2, and draw them if a file is named."""
    found = measured(side)
    if target:
        picture(found, target)
    return rows_of(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=SIDE, help="rows and columns; fewer for a quick look")
    parser.add_argument("--picture", type=Path, help="draw costs over samples per pixel")
    parser.add_argument("--child", nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(THREADS)
    if options.child:
        print(json.dumps(cost(options.child[0], int(options.child[1]), options.side)))
    elif options.child is not None:
        print(json.dumps(times(options.side)))
    else:
        print_table(run(options.picture, options.side))
