"""Figure 2: weight-sharing reconstruction of a 1280x720 frame with six kernels of 3 … 13 pixels.

Against unfold and softmax (kernel by kernel, as `reconstruct_by_softmax`) and against dense convolutions
with ones. Inference, without gradients; peak memory is that of PyTorch's allocator
(`tests.benchmarks.memory`), result included.

    python -m tests.benchmarks.reconstruction
"""

from __future__ import annotations

import torch

from models.ops.sharing import reconstruct, reconstruct_by_softmax
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.plain_wskp import dense_reconstruct
from tests.benchmarks.timing import Row, medians, print_table, row

HEIGHT, WIDTH = 720, 1280
SIZES = (3, 5, 7, 9, 11, 13)


def run() -> list[Row]:
    """Measure and return the rows of figure 2."""
    generator = torch.Generator().manual_seed(0)
    irradiance = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator)
    log_importance = torch.randn(1, 6, HEIGHT, WIDTH, generator=generator) * 3
    fusion = torch.randn(1, 6, HEIGHT, WIDTH, generator=generator)
    contestants = {"ours": reconstruct, "dense": dense_reconstruct, "softmax": reconstruct_by_softmax}
    calls = {
        name: lambda filter=function: filter(irradiance, log_importance, fusion, SIZES)
        for name, function in contestants.items()
    }
    with torch.no_grad():
        times = medians(calls, {"ours": 9, "dense": 9, "softmax": 3})
        memory = {name: peak_bytes(call) for name, call in calls.items()}
        exact = calls["softmax"]()
        error = float((calls["ours"]() - exact).abs().max() / exact.abs().max())
    softmax, dense = times["softmax"] / times["ours"], times["dense"] / times["ours"]
    share = memory["ours"] / memory["softmax"]
    return [
        *(row(f"reconstruction 1280x720, {name}", times[name] * 1e3, "ms") for name in times),
        row("reconstruction: unfold and softmax / ours", softmax, "x", ">= 8", softmax >= 8),
        row("reconstruction: dense convolutions / ours", dense, "x", ">= 1.7", dense >= 1.7),
        *(row(f"reconstruction: extra memory, {name}", memory[name] / 1e6, "MB") for name in memory),
        row("reconstruction: memory ours / unfold and softmax", share, "", "<= 0.08", share <= 0.08),
        row("reconstruction: largest difference to softmax", error, ""),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
