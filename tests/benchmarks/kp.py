"""KP: the 13x13 gather with kernels cut at the border, forward and backward, against unfolding the image.

Plain: unfold, mask, softmax, multiply, sum (`tests.models.plain_kp`), ordinary automatic differentiation. The
gradient of the logits is asked for, as in training, and then those of image and logits. Extra memory is the
peak of PyTorch's allocator less these gradients. A training step and inference of the network are shown
beside; there the gather's part is small beside the convolutions.

All run in one thread: on a busy machine a second one waits for a core, the longer the more short operations
there are.

    python -m tests.benchmarks.kp [WIDTHxHEIGHT]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from unittest import mock

import torch
from torch import Tensor

from models import KP
from models import kp as module
from models.ops.gather_inside import gather_inside
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.frames import random_buffers
from tests.models.plain_kp import unfold_gather

SIZE = 13
FRAME = (480, 270)
CROPS, SIDE = 2, 128
FASTER, SHARE, ERROR = 3.0, 0.1, 1e-4

Gather = Callable[[Tensor, Tensor, int], Tensor]


def run(frame: tuple[int, int] = FRAME) -> list[Row]:
    """Measure and return the rows.

    Args:
        frame: Width and height of the image that is gathered from.
    """
    torch.manual_seed(0)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*gather_rows(frame, False), *gather_rows(frame, True), *network_rows()]
    finally:
        torch.set_num_threads(before)


def gather_rows(frame: tuple[int, int], for_image: bool, repeats: int = 5) -> list[Row]:
    """The gather alone, forward and backward; with `for_image` also the gradient of the image."""
    width, height = frame
    image = torch.rand(1, 3, height, width).requires_grad_(for_image)
    logits = torch.randn(1, SIZE**2, height, width).requires_grad_()
    weights = torch.rand(1, 3, height, width)

    def forget() -> None:
        image.grad = logits.grad = None

    def once(gather: Gather) -> list[Tensor]:
        forget()
        result = gather(image, logits, SIZE)
        (result * weights).sum().backward()
        gradients = [tensor.grad for tensor in (image, logits) if tensor.grad is not None]
        return [result.detach(), *gradients]

    calls = {"ours": lambda: once(gather_inside), "plain": lambda: once(unfold_gather)}
    differences = zip(calls["ours"](), calls["plain"](), strict=True)
    error = max(float((one - other).abs().max() / other.abs().max()) for one, other in differences)
    times = medians(calls, dict.fromkeys(calls, repeats))
    asked = 4 * (logits.numel() + (image.numel() if for_image else 0))
    extra = {}
    for key, call in calls.items():
        forget()  # what is released during a call must have been taken during it
        extra[key] = peak_bytes(call) - asked
    name = f"KP gather {SIZE}x{SIZE}, {width}x{height}" + (", image too" if for_image else "")
    return compared(name, times, extra, error)


def compared(name: str, times: dict[str, float], extra: dict[str, int], error: float) -> list[Row]:
    """Return times, extra memory, their ratios and the difference of two contestants."""
    speed, share = times["plain"] / times["ours"], extra["ours"] / extra["plain"]
    return [
        *(row(f"{name}: {key}", time * 1e3, "ms") for key, time in times.items()),
        row(f"{name}: plain / ours", speed, "x", f">= {FASTER:g}", speed >= FASTER),
        *(row(f"{name}: extra memory, {key}", size / 1e6, "MB") for key, size in extra.items()),
        row(f"{name}: extra memory ours / plain", share, "", f"<= {SHARE:g}", share <= SHARE),
        row(f"{name}: largest difference", error, "", f"<= {ERROR:g}", error <= ERROR),
    ]


def network_rows(repeats: int = 3) -> list[Row]:
    """A training step on two crops and inference on as many, with our gather and with unfold; no targets."""
    network, buffers = KP(), random_buffers(CROPS, SIDE, SIDE)

    def step() -> None:
        network.train().zero_grad()
        network(buffers).color.mean().backward()

    @torch.no_grad()
    def inference() -> None:
        network.eval()(buffers)

    def unfolded(call: Callable[[], None]) -> None:
        def rows(image: Tensor, logits: Tensor, size: int, first: int) -> Tensor:
            return unfold_gather(image, logits, size)

        with (
            mock.patch.object(module, "gather_inside", unfold_gather),
            mock.patch.object(module, "gather_inside_rows", rows),
            mock.patch.object(module, "strip_rows", lambda tensor, numbers: tensor.shape[-2]),
        ):
            call()

    found: list[Row] = []
    for what, call in (("training step", step), ("inference", inference)):
        calls = {"ours": call, "plain": lambda call=call: unfolded(call)}
        times = medians(calls, dict.fromkeys(calls, repeats))
        memory = {}
        for key, contestant in calls.items():
            network.zero_grad()
            memory[key] = peak_bytes(contestant)
        name = f"KP {what}, {CROPS}x{SIDE}x{SIDE}"
        found += [row(f"{name}: {key}", time * 1e3, "ms") for key, time in times.items()]
        found.append(row(f"{name}: plain / ours", times["plain"] / times["ours"], "x"))
        found += [row(f"{name}: memory, {key}", size / 1e6, "MB") for key, size in memory.items()]
    return found


if __name__ == "__main__":
    size = sys.argv[1].split("x") if len(sys.argv) > 1 else FRAME
    print_table(run((int(size[0]), int(size[1]))))
