"""Table 3 and figures 6 and 10 of Fan et al. 2021: what real-time denoisers take for a 1280x720 frame.

One frame, float32, on all cores, deployed networks with random weights. Every network's calls are split by
a clock around the methods that predict: `prediction` is the time in these, `reconstruction` the rest of the
call. KP predicts its kernels row by row between filtering, so a difference of two measurements would not be
exact. The methods take turns in one process, so that a slow minute of the machine hits all alike, and times
are medians. Memory is the peak resident set during a call less the resident set before it, in a process of
its own for each. Multiply-adds are those of the convolutions. RAE stands for ONND, on the first frame of a
sequence, which costs what the others cost; nothing of it is a reconstruction.

"paper" is the published ratio or time, on an RTX 2080 Ti with operators written in CUDA (ONND: Titan X).

The order of totals is the paper's: WSKP with three layers, with six, NBGD with two, MR-WSKP, MR-KP, KP, NBGD
with seven, RAE. Where quotients to WSKP with six layers differ, and why, as measured on two cores:
- WSKP's filter visits the 454 taps of six kernels in the paper, and KP's with 169 costs about the same. Here
  WSKP needs no taps but box sums, at most ten additions per channel and kernel, while KP takes an exponential
  for each tap: ten times as long. So KP takes 3.1 times WSKP's time (paper 2.16). Its network takes 2.3 times
  that of WSKP (paper 2.2), for three times the multiply-adds;
- NBGD with two layers takes 1.5 times WSKP's time (paper 1.08), with a quarter of its multiply-adds: a pixel
  is added to eight cells of each of three grids and reads as many, by index, which is 70 % of the time;
- the U-Nets take more than their multiply-adds say, MR-KP 2.6 times WSKP's prediction for twice as many
  (paper 2.0): a fifth of the time in one thread only pools and joins maps of 48 and 96 channels;
- RAE takes 9.7 times WSKP's time, as its multiply-adds say; the paper measured ONND elsewhere (4.27);
- KP takes 1.6 times WSKP's memory (paper 3.16), since its logits exist for some rows at a time.

    python -m tests.benchmarks realtime
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

import models
from models import Denoiser
from models.denoiser import Buffers
from tests.benchmarks.realtime_growth import growth_rows
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import random_buffers
from trainer.benchmarking.machine import usable_threads
from trainer.benchmarking.memory import reset_peak, status

HEIGHT, WIDTH = 720, 1280
REPEATS = 7
SMALL = 64


class Method(NamedTuple):
    """A row of table 3.

    Attributes:
        network: Name of the class in `models`.
        arguments: Of its constructor.
        predicting: Methods, of the network or of a part of it, whose time is that of the prediction.
        paper: Milliseconds in the paper: the whole, prediction, reconstruction; those that it states.
    """

    network: str
    arguments: dict[str, Any]
    predicting: tuple[str, ...]
    paper: tuple[float, ...]


_GUIDES = ("_clean", "_features", "_guides")
METHODS = {
    "WSKP, 6 layers": Method("WSKP", {}, ("predict",), (12.89, 11.75, 1.14)),
    "WSKP, 3 layers": Method("WSKP", {"layers": 3}, ("predict",), (6.58, 5.47, 1.11)),
    "MR-WSKP": Method("MultiResolutionWSKP", {}, ("predict",), (22.70, 21.85, 0.85)),
    "KP": Method("KP", {}, ("_hidden", "blocks.5.rows"), (27.86, 26.23, 1.22)),
    "MR-KP": Method("MRKP", {}, ("predict",), (24.73, 23.73, 1.00)),
    "NBGD, 2 layers": Method("NBGD", {}, _GUIDES, (13.97, 7.84, 6.13)),
    "NBGD, 7 layers": Method("NBGD", {"layers": 7}, _GUIDES, (50.28, 44.16, 6.12)),
    "RAE": Method("RAE", {}, ("forward",), (55.00,)),
}
"""Name in the table → method. The first is what the others are compared with."""

BASE = next(iter(METHODS))
PARTS = ("total", "prediction", "reconstruction")
PAPER_MEMORY_GB = {BASE: 1.25, "KP": 3.95}


class Cost(NamedTuple):
    """What a call takes.

    Attributes:
        total: Seconds.
        prediction: Seconds of it.
        reconstruction: The other seconds.
        memory: Bytes.
        multiply_adds: Of convolutions, per pixel.
    """

    total: float
    prediction: float
    reconstruction: float
    memory: int
    multiply_adds: float


class Timed:
    """A deployed network with random weights whose calls are split.

    Args:
        method: Which network.
        now: The clock, in seconds.

    Attributes:
        parts: Seconds of prediction and of reconstruction of every call.
    """

    def __init__(self, method: Method, now: Callable[[], float] = time.perf_counter) -> None:
        self.net, self.now = network(method), now
        self.parts: list[tuple[float, float]] = []
        self._inside = 0.0
        for path in method.predicting:
            owner, _, name = path.rpartition(".")
            part = self.net.get_submodule(owner)
            setattr(part, name, self._clocked(getattr(part, name)))

    def _clocked(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def clocked(*arguments: Any, **options: Any) -> Any:
            began = self.now()
            made = function(*arguments, **options)
            self._inside += self.now() - began
            return made

        return clocked

    def __call__(self, buffers: Buffers) -> Tensor:
        """Denoise, and note the seconds."""
        self._inside, began = 0.0, self.now()
        color = self.net(buffers).color
        self.parts.append((self._inside, self.now() - began - self._inside))
        return color


def network(method: Method) -> Denoiser:
    """Return a deployed network with random weights."""
    torch.manual_seed(0)
    made: Denoiser = getattr(models, method.network)(**method.arguments)
    return made.eval().requires_grad_(False).deploy()


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Compute in so many threads, without gradients."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)


def run(
    height: int = HEIGHT,
    width: int = WIDTH,
    repeats: int = REPEATS,
    names: Sequence[str] = tuple(METHODS),
    count: int | None = None,
) -> list[Row]:
    """Measure and return the rows.

    Args:
        height: Rows of the frame, a multiple of 16.
        width: Columns, likewise.
        repeats: How often each call is measured.
        names: Methods of table 3, the base among them.
        count: Threads; None: all cores.
    """
    with threads(count or usable_threads()):
        buffers = random_buffers(1, height, width)
        rows = table_rows(costs(buffers, repeats, names))
        rows += growth_rows(buffers, repeats)
    return rows


def costs(buffers: Buffers, repeats: int, names: Sequence[str]) -> dict[str, Cost]:
    """Measure methods: their times in turns, and memory."""
    timed = {name: Timed(METHODS[name]) for name in names}
    calls = {name: partial(one, buffers) for name, one in timed.items()}
    totals = medians(calls, dict.fromkeys(calls, repeats))
    found = {}
    for name, one in timed.items():
        prediction, reconstruction = (statistics.median(part) for part in zip(*one.parts[1:], strict=True))
        memory = _grown_apart(name, *buffers["depth"].shape[-2:])
        found[name] = Cost(totals[name], prediction, reconstruction, memory, multiply_adds(one.net))
    return found


def table_rows(found: Mapping[str, Cost]) -> list[Row]:
    """Return table 3, and the quotients of time and memory with those of the base."""
    rows: list[Row] = []
    for name, cost in found.items():
        # Of ONND the paper states one time, as there is one of RAE: its rows end there.
        for what, theirs, seconds in zip(PARTS, METHODS[name].paper, cost[: len(PARTS)], strict=False):
            rows.append(row(f"{name}: {what}", seconds * 1e3, "ms", f"paper {theirs:g} ms"))
        rows.append(row(f"{name}: multiply-adds", cost.multiply_adds / 1e3, "k/pixel"))
        rows.append(row(f"{name}: memory", cost.memory / 1e6, "MB"))
    base, base_ms = found[BASE], METHODS[BASE].paper[0]
    for name, cost in found.items():
        note = f"paper {METHODS[name].paper[0] / base_ms:.2f}"
        rows.append(row(f"total, {name} / {BASE}", cost.total / base.total, "x", note))
    for name, cost in found.items():
        stated = PAPER_MEMORY_GB.get(name)
        note = f"paper {stated / PAPER_MEMORY_GB[BASE]:.2f}" if stated else ""
        rows.append(row(f"memory, {name} / {BASE}", cost.memory / base.memory, "x", note))
    return rows


def multiply_adds(net: Denoiser) -> float:
    """Return what convolutions multiply per pixel of a frame whose sides suit the network."""
    with FlopCounterMode(display=False) as counter:
        net(random_buffers(1, SMALL, SMALL))
    return counter.get_total_flops() / 2 / SMALL**2


def grown(name: str, height: int, width: int, count: int) -> int:
    """Return by how many bytes resident memory grows in a call; for a process of its own."""
    net = network(METHODS[name])
    buffers = random_buffers(1, height, width)
    with threads(count):
        net(random_buffers(1, SMALL, SMALL))  # threads and code are loaded; the frame's memory is not
        before = reset_peak()
        net(buffers)
        return status("VmHWM") - before


def _grown_apart(name: str, height: int, width: int) -> int:
    command = [sys.executable, "-m", "tests.benchmarks.realtime", "--child", name]
    command += ["--size", str(height), str(width), "--threads", str(torch.get_num_threads())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stderr.strip()[-500:]}")
    return int(json.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(HEIGHT, WIDTH), help="rows and columns")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="measured calls of each")
    parser.add_argument("--threads", type=int, default=usable_threads(), help="all cores if not given")
    parser.add_argument("--child", choices=METHODS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    height, width = options.size
    if options.child:
        print(json.dumps(grown(options.child, height, width, options.threads)))
    else:
        print_table(run(height, width, options.repeats, count=options.threads))
