"""Figure 3 of the per-sample methods: what the stages of Optimized take at 1920x1080 with 8 spp.

One call, untiled, in a process of its own on two threads, after one on a small image; random weights. Beside
it table 3 of Munkberg and Hasselgren 2020, on a GeForce RTX 2080 Ti with compute shaders written for it, in
milliseconds and as shares. The sample reducer is everything that makes embeddings of samples, reading and
mapping their features included. Embeddings are not stored, so they are computed again for the partitioner:
that second time is a stage of its own here, "sample reducer, again", and there is none in the paper. Nor is
there one for the largest depth of the frame, which the authors' data come divided by.

    python -m tests.benchmarks.stages [--size HEIGHT WIDTH]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from typing import Any

import torch
from torch import Tensor

from models import Optimized
from models.blocks.per_sample import Frame, Seen
from models.denoiser import Buffers
from models.layers import Composite, Sorted
from tests.benchmarks.timing import Row, print_table, row
from tests.models.frames import random_samples
from trainer.benchmarking.memory import reset_peak, status

SIZE, SPP, THREADS = (1080, 1920), 8, 2
AGAIN, MEASURE = "sample reducer, again", "largest depth of the frame"
PAPER_MS = {"sample reducer": 3.9, "U-Net": 18.8, "sample partitioner": 10.2, "layer filtering": 5.3}
PAPER_TOTAL_MS = 38.3
LIMIT = 0.05


class Timed(Optimized):
    """The network with a clock: seconds that each part took are added up under its name in `seconds`."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: dict[str, float] = {}
        self.unet.register_forward_pre_hook(lambda *_: self._clock("U-Net", -1))
        self.unet.register_forward_hook(lambda *_: self._clock("U-Net", 1))

    def _clock(self, name: str, sign: int) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + sign * time.perf_counter()

    def _frame(self, buffers: Buffers) -> Frame:
        self._clock(MEASURE, -1)
        made = super()._frame(buffers)
        self._clock(MEASURE, 1)
        return made

    def _contexts(self, frame: Frame) -> list[Tensor]:
        self._clock("contexts", -1)
        made = super()._contexts(frame)
        self._clock("contexts", 1)
        return made

    def _sorted(self, frame: Frame, context: Tensor) -> Sorted:
        before = self.seconds.get("embedding", 0.0)
        self._clock("layers", -1)
        made = super()._sorted(frame, context)
        self._clock("layers", 1)
        self.seconds[AGAIN] = self.seconds["embedding"] - before
        return made

    def _composited(self, layers: Sorted, contexts: list[Tensor]) -> Composite:
        self._clock("layer filtering", -1)
        made = super()._composited(layers, contexts)
        self._clock("layer filtering", 1)
        return made

    def _seen(self, samples: Tensor, frame: Frame) -> Seen:
        self._clock("embedding", -1)
        made = super()._seen(samples, frame)
        self._clock("embedding", 1)
        return made

    def _embedded(self, seen: Seen) -> Tensor:
        self._clock("embedding", -1)
        made = super()._embedded(seen)
        self._clock("embedding", 1)
        return made

    def stages(self) -> dict[str, float]:
        """Return the seconds of each stage."""
        found = self.seconds
        return {
            MEASURE: found[MEASURE],
            "sample reducer": found["contexts"] - found["U-Net"],
            "U-Net": found["U-Net"],
            AGAIN: found[AGAIN],
            "sample partitioner": found["layers"] - found[AGAIN],
            "layer filtering": found["layer filtering"],
        }


def child(height: int, width: int) -> dict[str, Any]:
    """Denoise a frame and measure; runs in its own process."""
    torch.manual_seed(0)
    net = Timed().eval().requires_grad_(False)
    samples = torch.cat([random_samples(1, 1, height, width, seed) for seed in range(SPP)], 1)
    with torch.inference_mode():
        net({"samples": samples[..., :64, :64].contiguous()})  # threads and code are loaded
        net.seconds.clear()
        before, began = reset_peak(), time.perf_counter()
        net({"samples": samples})
        total, memory = time.perf_counter() - began, status("VmHWM") - before
    return {"stages": net.stages(), "total": total, "memory": memory, "input": samples.nbytes}


def rows_of(found: dict[str, Any], size: tuple[int, int]) -> list[Row]:
    """Return the table, the paper's beside it."""
    name, total = f"{size[1]}x{size[0]}, {SPP} spp", found["total"]
    rows: list[Row] = []
    for stage, seconds in found["stages"].items():
        theirs = PAPER_MS.get(stage)
        note = "" if theirs is None else f"paper {theirs:g} ms"
        share = "" if theirs is None else f"paper {100 * theirs / PAPER_TOTAL_MS:.0f} %"
        rows.append(row(f"{name}: {stage}", seconds, "s", note))
        rows.append(row(f"{name}: {stage}, share", 100 * seconds / total, "%", share))
    rest = 1 - sum(found["stages"].values()) / total
    return [
        *rows,
        row(f"{name}: total", total, "s", f"paper {PAPER_TOTAL_MS:g} ms"),
        row(f"{name}: outside the stages", 100 * rest, "%", f"<= {100 * LIMIT:g}", abs(rest) <= LIMIT),
        row(f"{name}: memory beside the input", found["memory"] / 1e9, "GB"),
        row(f"{name}: input", found["input"] / 1e9, "GB"),
    ]


def run(size: tuple[int, int] = SIZE) -> list[Row]:
    """Return the rows of figure 3."""
    command = [sys.executable, "-m", "tests.benchmarks.stages", "--child", "--size", *map(str, size)]
    waiting = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}  # as the trainer command has it
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=waiting)
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip()[-500:])
    return rows_of(json.loads(done.stdout.splitlines()[-1]), size)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, help="rows and columns")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(THREADS)
    if options.child:
        print(json.dumps(child(*options.size)))
    else:
        print_table(run(tuple(options.size)))
