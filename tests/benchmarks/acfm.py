"""Figure 3, ACFM: its training step and inference against the literal form, and the critic's step.

Plain: `tests.models.plain_acfm`, every convolution by itself, everything kept. A step is one component's
network on a patch of 128x128, forward, L1 in log space and backward; both components cost the same. Memory is
the peak of PyTorch's allocator. Times are processor seconds of one thread, so that other work on the machine
counts as little as it can. The critic's step is its scores of fake and real, the gradient penalty, backward.

    python -m tests.benchmarks.acfm
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from models import ACFM
from models.critic import Critic
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, print_table, row
from tests.models.plain_acfm import plain_copy

SIZE = 128
LIMIT = 1e-5


def run() -> list[Row]:
    """Measure and return the rows."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*_network_rows(), *_critic_rows()]
    finally:
        torch.set_num_threads(threads)


def _network_rows() -> list[Row]:
    torch.manual_seed(0)
    ours = ACFM(start=0.5).diffuse
    plain = plain_copy(ours)
    noisy, guides, target = (torch.rand(1, channels, SIZE, SIZE) for channels in (3, 7, 3))
    inner = [image.contiguous(memory_format=torch.channels_last) for image in (noisy, guides)]
    checkpointed = ACFM(start=0.5, checkpointed=16).diffuse
    checkpointed.load_state_dict(ours.state_dict())
    steps: dict[str, Callable[[], None]] = {
        "plain": lambda: _step(plain, [noisy, guides], target),
        "ours": lambda: _step(ours, inner, target),
        "all blocks checkpointed": lambda: _step(checkpointed, inner, target),
        "ours, bfloat16": lambda: _step(ours, inner, target, bfloat16=True),
    }
    calls: dict[str, Callable[[], Any]] = {
        "plain": lambda: _inference(plain, [noisy, guides]),
        "ours": lambda: _inference(ours, inner),
        "ours, bfloat16": lambda: _inference(ours, inner, bfloat16=True),
    }
    error = _difference(ours, plain, noisy, guides)
    return [
        *_compared("step 128x128", steps),
        *_compared("inference 128x128", calls),
        row("ACFM: ours against plain, float32", error, "", f"<= {LIMIT}", error <= LIMIT),
    ]


def _compared(what: str, calls: Mapping[str, Callable[[], Any]]) -> list[Row]:
    times = _processor_seconds(calls)
    memory = {name: peak_bytes(call) for name, call in calls.items()}
    rows = []
    for name in calls:
        rows.append(row(f"ACFM {what}, {name}: time", times[name], "s"))
        rows.append(row(f"ACFM {what}, {name}: peak memory", memory[name] / 1e6, "MB"))
        if name != "plain":
            rows.append(row(f"ACFM {what}, {name} / plain: time", times[name] / times["plain"], "x"))
            rows.append(row(f"ACFM {what}, {name} / plain: memory", memory[name] / memory["plain"], "x"))
    return rows


def _processor_seconds(calls: Mapping[str, Callable[[], Any]], rounds: int = 3) -> dict[str, float]:
    """Return the median processor time of every call, taken in turns after one unmeasured round."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            began = time.process_time()
            call()
            if turn:
                times[name].append(time.process_time() - began)
    return {name: statistics.median(values) for name, values in times.items()}


def _step(network: nn.Module, images: list[Tensor], target: Tensor, bfloat16: bool = False) -> None:
    network.zero_grad(set_to_none=True)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
        made = network(*images)
    (made.float() - target).abs().mean().backward()


@torch.no_grad()
def _inference(network: nn.Module, images: list[Tensor], bfloat16: bool = False) -> Tensor:
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
        made: Tensor = network(*images)
    return made


def _difference(ours: nn.Module, plain: nn.Module, noisy: Tensor, guides: Tensor) -> float:
    found, expected = _inference(ours, [noisy, guides]), _inference(plain, [noisy, guides])
    return float((found - expected).abs().max() / expected.abs().max())


def _critic_rows() -> list[Row]:
    """Time the critic with and without the gradient penalty."""
    torch.manual_seed(0)
    critic = Critic(SIZE)
    fake, real = torch.rand(2, 2, 3, SIZE, SIZE)

    def step(weight: float) -> None:
        critic.zero_grad(set_to_none=True)
        loss = (critic(fake).mean() - critic(real).mean()) / 2
        if weight:
            between = ((fake + real) / 2).requires_grad_()
            (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
            loss = loss + weight * (slope.flatten(1).norm(dim=1) - 1).square().mean()
        loss.backward()

    times = _processor_seconds({"without": lambda: step(0.0), "with": lambda: step(10.0)}, rounds=2)
    return [
        row("critic step 2x128x128, without penalty: time", times["without"], "s"),
        row("critic step 2x128x128, with penalty: time", times["with"], "s"),
        row("critic step, with / without penalty", times["with"] / times["without"], "x"),
    ]


if __name__ == "__main__":
    print_table(run())
