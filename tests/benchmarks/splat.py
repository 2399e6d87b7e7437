"""Splat of 8 samples with 17x17 kernels, forward and backward, against forming all products and folding them.

Plain: exp of all logits, their products with the values, `torch.nn.functional.fold`, ordinary automatic
differentiation (`tests.models.plain_splat`). Extra memory is the peak of PyTorch's allocator less the
gradients that are asked for: those of values and logits.

    python -m tests.benchmarks.splat
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from models.ops.splat import Splatted, splat_exp
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.plain_splat import fold_splat

SAMPLES, SIDE, SIZE = 8, 128, 17
EPSILON = 1e-6


def run(repeats: int = 5) -> list[Row]:
    """Measure and return the rows."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(1, SAMPLES, 3, SIDE, SIDE, generator=generator).requires_grad_()
    logits = torch.randn(1, SAMPLES, SIZE**2, SIDE, SIDE, generator=generator).requires_grad_()
    target = torch.rand(1, 3, SIDE, SIDE, generator=generator)

    def once(splat: Callable[[Tensor, Tensor, int], Splatted]) -> tuple[Tensor, Tensor, Tensor]:
        values.grad = logits.grad = None
        sums = splat(values, logits, SIZE)
        image = sums.total / (sums.weight + EPSILON)
        (image * target).sum().backward()
        assert values.grad is not None
        assert logits.grad is not None
        return image.detach(), values.grad, logits.grad

    calls = {"ours": lambda: once(splat_exp), "plain": lambda: once(folded)}
    error = max(
        float((one - other).abs().max() / other.abs().max())
        for one, other in zip(calls["ours"](), calls["plain"](), strict=True)
    )
    times = medians(calls, dict.fromkeys(calls, repeats))
    gradients = 4 * (values.numel() + logits.numel())
    memory = {name: peak_bytes(call) for name, call in calls.items()}
    speed = times["plain"] / times["ours"]
    extra = {name: peak - gradients for name, peak in memory.items()}
    share = extra["ours"] / extra["plain"]
    name = f"splat {SIZE}x{SIZE}, {SAMPLES} samples, {SIDE}x{SIDE}"
    return [
        *(row(f"{name}: {key}", time * 1e3, "ms") for key, time in times.items()),
        row(f"{name}: plain / ours", speed, "x", ">= 3", speed >= 3),
        *(row(f"{name}: memory, {key}", size / 1e6, "MB") for key, size in memory.items()),
        *(row(f"{name}: extra memory, {key}", size / 1e6, "MB") for key, size in extra.items()),
        row(f"{name}: extra memory ours / plain", share, "", "<= 0.1", share <= 0.1),
        row(f"{name}: memory ours / plain", memory["ours"] / memory["plain"], ""),
        row(f"{name}: largest difference", error, "", "<= 1e-5", error <= 1e-5),
    ]


def folded(values: Tensor, logits: Tensor, size: int) -> Splatted:
    """The plain form of `splat_exp`."""
    shift = logits.amax((1, 2), keepdim=True)
    return Splatted(*fold_splat(values, (logits - shift).exp(), size))


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
