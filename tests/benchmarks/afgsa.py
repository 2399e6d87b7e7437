"""AFGSA, figure 1: a training step of the full network on one 128x128 patch, against a plain implementation.

Plain (`tests.models.plain_afgsa`): keys and values unfolded, einsum, softmax, concatenations, PyTorch's
default memory format. A step is forward, L1 in log space and backward. Peak memory is measured twice: what
PyTorch's allocator hands out (`tests.benchmarks.memory`; the gradients of the weights, 37 MB, are part of
it), and the peak resident set of a process of its own less what was resident before the step, which sees the
scratch memory of oneDNN as well.

Gradients are compared in float64 on a narrow network, as the largest difference relative to the largest
entry of each tensor. In float32 each implementation is compared with plain float64 on the full network, for
a linear loss, in the norm, over several batches: at the kinks of ReLU a rounding error flips a sign now and
then, in either.

`afgsa_search` and `afgsa_inference` have what else was tried, and whole frames.

    python -m tests.benchmarks.afgsa
"""

from __future__ import annotations

import copy
import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from models import AFGSA
from models.published import load_published
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import split_buffers
from tests.models.plain_afgsa import PlainAFGSA
from trainer.benchmarking.memory import reset_peak, status

SIZE = 128
Batch = Mapping[str, Tensor]


class Contestant(NamedTuple):
    """A network, and how it predicts log(1 + radiance) from a batch."""

    network: nn.Module
    predict: Callable[[Batch], Tensor]

    def step(self, batch: Batch) -> None:
        """Forward, L1 in log space and backward."""
        self.network.zero_grad(set_to_none=True)
        self.loss(batch).backward()

    def loss(self, batch: Batch) -> Tensor:
        """L1 in log space."""
        return (self.predict(batch).float() - torch.log1p(batch["reference"])).abs().mean()


def plain_inputs(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return log colour and auxiliary channels as the plain network takes them."""
    depth = batch["depth"] / batch["depth"].amax((1, 2, 3), keepdim=True)
    return batch["color"].log1p(), torch.cat([(batch["normal"] + 1) / 2, depth, batch["albedo"]], 1)


def contestant(network: nn.Module) -> Contestant:
    """Return either implementation as a contestant."""
    if isinstance(network, AFGSA):
        return Contestant(network, network.predict)
    return Contestant(network, lambda batch: cast(Tensor, network(*plain_inputs(batch))))


def contestants(width: int = 256, blocks: int = 5) -> dict[str, Contestant]:
    """Return the plain network, ours with the same weights, and ours with all blocks checkpointed."""
    torch.manual_seed(0)
    plain = PlainAFGSA(width=width, blocks=blocks)
    ours = load_published("afgsa", plain.state_dict()).train()
    checkpointed = copy.deepcopy(ours)
    checkpointed.checkpointed = blocks
    found = {"plain": plain, "ours": ours, "ours, checkpointed": checkpointed}
    return {name: contestant(network) for name, network in found.items()}


def allocated(chosen: Contestant, batch: Batch) -> int:
    """Return the allocator's peak in one step."""
    chosen.network.zero_grad(set_to_none=True)
    return peak_bytes(lambda: chosen.loss(batch).backward())


def resident(name: str) -> int:
    """Return the peak of resident memory in one step of a contestant, in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.afgsa", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stderr.strip()[-500:]}")
    return int(json.loads(done.stdout.splitlines()[-1]))


def child(name: str) -> int:
    """Measure the resident memory of one step; runs in its own process."""
    chosen = contestants()[name]
    chosen.step(split_buffers(1, 32, 32))  # threads and code are loaded
    chosen.network.zero_grad(set_to_none=True)
    batch = split_buffers(1, SIZE, SIZE)
    before = reset_peak()
    chosen.step(batch)
    return status("VmHWM") - before


def gradients(chosen: Contestant) -> dict[str, Tensor]:
    """Return the gradients under the names of our network."""
    network = chosen.network
    found = {name: value.grad for name, value in network.named_parameters() if value.grad is not None}
    if isinstance(network, AFGSA):
        return found
    return dict(load_published("afgsa", found).named_parameters())


def differences(found: Contestant, expected: Contestant, norm: bool = False) -> float:
    """Return the largest difference of a gradient, relative to its tensor's largest entry or norm."""
    wanted, errors = gradients(expected), []
    for name, gradient in gradients(found).items():
        reference = wanted[name].double()
        difference = gradient.double() - reference
        pair = (
            (difference.norm(), reference.norm()) if norm else (difference.abs().max(), reference.abs().max())
        )
        errors.append(float((pair[0] / pair[1]).detach()))
    return max(errors)


def double_difference() -> float:
    """Return how far our gradients are from plain ones in float64, on a narrow network."""
    batch = {name: image.double() for name, image in split_buffers(1, 40, 48).items()}
    narrow = contestants(width=32, blocks=2)
    for chosen in narrow.values():
        chosen.network.double()
        chosen.step(batch)
    plain = narrow["plain"]
    return max(differences(narrow[name], plain) for name in ("ours", "ours, checkpointed"))


def rounding(full: dict[str, Contestant], seeds: int = 5) -> dict[str, float]:
    """Return each implementation's float32 gradients' distance from plain float64, for a linear loss.

    The median over several small batches: where a sign flips, in either implementation, it is 1e-3.
    """
    exact = contestant(copy.deepcopy(full["plain"].network).double())
    errors: dict[str, list[float]] = {name: [] for name in full}
    for seed in range(seeds):
        batch = split_buffers(1, 24, 24, seed)
        weights = torch.randn(1, 3, 24, 24, generator=torch.Generator().manual_seed(seed))
        wide = {name: image.double() for name, image in batch.items()}
        exact.network.zero_grad(set_to_none=True)
        (exact.predict(wide) * weights).mean().backward()
        for name, chosen in full.items():
            chosen.network.zero_grad(set_to_none=True)
            (chosen.predict(batch) * weights).mean().backward()
            errors[name].append(differences(chosen, exact, norm=True))
    return {name: statistics.median(values) for name, values in errors.items()}


def output_difference(full: dict[str, Contestant], batch: Batch) -> float:
    """Return the largest difference of the outputs, relative to the largest output."""
    with torch.no_grad():
        found, expected = full["ours"].predict(batch), full["plain"].predict(batch)
    return float((found - expected).abs().max() / expected.abs().max())


def exactness_rows(full: dict[str, Contestant], batch: Batch) -> list[Row]:
    """Compare outputs and gradients."""
    same, double, errors = output_difference(full, batch), double_difference(), rounding(full)
    limit = max(1e-5, 2 * errors["plain"])
    return [
        row("step: outputs, ours against plain", same, "", "<= 1e-5", same <= 1e-5),
        row("step: gradients, ours against plain, float64, narrow", double, "", "<= 1e-5", double <= 1e-5),
        row("step: gradients, rounding of plain", errors["plain"], ""),
        *(
            row(
                f"step: gradients, rounding of {name}",
                errors[name],
                "",
                f"<= {limit:.1g}",
                errors[name] <= limit,
            )
            for name in ("ours", "ours, checkpointed")
        ),
    ]


def step_rows(repeats: int = 5) -> list[Row]:
    """Measure figure 1."""
    batch, full = split_buffers(1, SIZE, SIZE), contestants()
    exact = exactness_rows(full, batch)
    calls = {name: (lambda chosen=chosen: chosen.step(batch)) for name, chosen in full.items()}
    times = medians(calls, dict.fromkeys(calls, repeats))
    memory = {name: allocated(chosen, batch) for name, chosen in full.items()}
    peaks = {name: resident(name) for name in full}
    rows = [row(f"step 1x{SIZE}x{SIZE}: {name}", seconds * 1e3, "ms") for name, seconds in times.items()]
    rows += [row(f"step: peak memory, {name}", size / 1e6, "MB") for name, size in memory.items()]
    rows += [row(f"step: peak resident, {name}", size / 1e6, "MB") for name, size in peaks.items()]
    speed = times["ours"] / times["plain"]
    rows.append(row("step: time, ours / plain", speed, "", "<= 1", speed <= 1))
    slower = {name: times["ours, checkpointed"] / times[name] for name in ("plain", "ours")}
    rows.append(
        row("step: time, checkpointed / plain", slower["plain"], "", "<= 1.4", slower["plain"] <= 1.4)
    )
    rows.append(row("step: time, checkpointed / ours", slower["ours"], ""))
    for name, limit in (("ours", 0.6), ("ours, checkpointed", 0.35)):
        for kind, sizes in (("memory", memory), ("resident", peaks)):
            share = sizes[name] / sizes["plain"]
            rows.append(row(f"step: {kind}, {name} / plain", share, "", f"<= {limit}", share <= limit))
    return exact + rows


def run() -> list[Row]:
    """Measure both figures, and what else was tried."""
    from tests.benchmarks import afgsa_inference, afgsa_search

    return [*step_rows(), *afgsa_search.run(), *afgsa_inference.run()]


if __name__ == "__main__":
    torch.set_num_threads(2)
    if len(sys.argv) > 1:
        print(json.dumps(child(sys.argv[1])))
    else:
        print_table(step_rows())
