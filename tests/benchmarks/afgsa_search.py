"""AFGSA: what else is exact and faster, where a step's time goes, and what the machine could do at most.

Every ratio is taken within this run, candidates in turns. "Exact" is meant up to the rounding of float32; the
error of each candidate is the largest difference relative to the largest value of the result in float64.

Tried on the layers of the network at 128x128 pixels, forward and backward unless said otherwise:
- memory format: channels innermost against PyTorch's default, in both precisions;
- merging 1x1 convolutions that share an input (queries and keys; the fusion's first half and values);
- splitting the fusion's convolution over its two inputs, against a concatenation;
- merging the extractor's 1x1, 3x3 and 5x5 convolutions into one 5x5 convolution padded with zeros;
- Winograd's F(2x2, 3x3) and F(4x4, 3x3) (Lavin and Gray 2016, doi:10.1109/CVPR.2016.435) as matrix products,
  forward only;
- float32 products as three products of bfloat16 parts (x = high + low, without low times low), forward only;
- bfloat16 under autocast, whole steps.

The limit of the machine: the best matrix product measured here. Arithmetic is what PyTorch's counter finds in
a plain step (2 per multiplication and addition). The share of the convolutions is their part of the
profiler's time of a step of ours.

    python -m tests.benchmarks.afgsa_search
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks.afgsa import SIZE, Batch, Contestant, contestants
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.benchmarks.winograd import winograd
from tests.models.frames import split_buffers

CHANNELS, REPEATS = 256, 5
CONVOLUTIONS = ("conv", "mkldnn")
FORMATS = {"default": torch.contiguous_format, "channels innermost": torch.channels_last}
Call = Callable[[], object]
_ONEDNN: Any = torch.backends.mkldnn


def run() -> list[Row]:
    """Return the rows of the search."""
    batch, full = split_buffers(1, SIZE, SIZE), contestants()
    return [*layer_rows(), *forward_rows(), *step_rows(full, batch), *limit_rows(full, batch)]


def layer_rows() -> list[Row]:
    """Exact alternatives for single layers, forward and backward."""
    calls: dict[str, Call] = {}
    for name, memory_format in FORMATS.items():
        for kind, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
            calls[f"3x3, {kind}, {name}"] = _convolution(CHANNELS, CHANNELS, 3, memory_format, dtype)
            calls[f"1x1, {kind}, {name}"] = _convolution(CHANNELS, CHANNELS, 1, memory_format, dtype)
    calls |= {"two of one input": _two(merged=False), "merged": _two(merged=True)}
    calls |= {"concatenated": _fusion(split=False), "split": _fusion(split=True)}
    calls |= {"extractor": _extractor(merged=False), "extractor, one 5x5": _extractor(merged=True)}
    times = medians(calls, dict.fromkeys(calls, REPEATS))
    first, last = FORMATS
    rows = [
        row(
            f"{kind} convolution: time, {last} / {first}",
            times[f"{kind}, {last}"] / times[f"{kind}, {first}"],
            "",
        )
        for kind in ("3x3, float32", "1x1, float32", "3x3, bfloat16", "1x1, bfloat16")
    ]
    for kind in ("3x3", "1x1"):
        speed = times[f"{kind}, float32, {last}"] / times[f"{kind}, bfloat16, {last}"]
        rows.append(row(f"{kind} convolution, {last}: float32 / bfloat16 time", speed, "x"))
    for name, (new, old) in {
        "1x1 convolutions of one input: time, merged / two": ("merged", "two of one input"),
        "fusion: time, split / concatenated": ("split", "concatenated"),
        "extractor: time, one 5x5 / three convolutions": ("extractor, one 5x5", "extractor"),
    }.items():
        rows.append(row(name, times[new] / times[old], ""))
    return rows


def forward_rows() -> list[Row]:
    """Other algorithms for the 3x3 convolution, forward only."""
    image, weight = _image(CHANNELS, 3).relu_(), _weight(CHANNELS, CHANNELS, 3)
    pieces = torch.cat([_high(weight), _high(weight), weight - _high(weight)], 1)
    calls: dict[str, Callable[[], Tensor]] = {
        "direct": lambda: F.conv2d(image, weight),
        "Winograd F(2x2)": winograd(image, weight, 2),
        "Winograd F(4x4)": winograd(image, weight, 4),
        "three bfloat16 products": lambda: _three_products(image, pieces),
    }
    exact = F.conv2d(image.double(), weight.double())
    with torch.no_grad():
        errors = {n: float((call() - exact).abs().max() / exact.abs().max()) for n, call in calls.items()}
        times = medians(calls, dict.fromkeys(calls, REPEATS))
    rows = [row("3x3 convolution forward, direct: error", errors["direct"], "")]
    for name in list(calls)[1:]:
        rows.append(row(f"3x3 convolution forward: time, {name} / direct", times[name] / times["direct"], ""))
        rows.append(row(f"3x3 convolution forward, {name}: error", errors[name], ""))
    return rows


def step_rows(full: dict[str, Contestant], batch: Batch) -> list[Row]:
    """Whole steps: bfloat16 in both implementations."""

    def lowered(name: str) -> Call:
        def call() -> None:
            full[name].network.zero_grad(set_to_none=True)
            with torch.autocast("cpu", torch.bfloat16):
                loss = full[name].loss(batch)
            loss.backward()

        return call

    calls: dict[str, Call] = {"float32": lambda: full["ours"].step(batch)}
    calls |= {"ours": lowered("ours"), "plain": lowered("plain")}
    times = medians(calls, dict.fromkeys(calls, 3))
    with torch.no_grad():
        exact = full["ours"].predict(batch)
        with torch.autocast("cpu", torch.bfloat16):
            error = (full["ours"].predict(batch) - exact).abs().max() / exact.abs().max()
    return [
        row("step, ours: float32 / bfloat16 time", times["float32"] / times["ours"], "x"),
        row("step, bfloat16: time, ours / plain", times["ours"] / times["plain"], ""),
        row("step, bfloat16: error of the output", float(error), ""),
    ]


def limit_rows(full: dict[str, Contestant], batch: Batch) -> list[Row]:
    """The arithmetic of a step, what the machine can do, and how near a step comes to it."""
    counter = FlopCounterMode(display=False)
    with counter:
        full["plain"].step(batch)
    work = counter.get_total_flops()
    counts = counter.get_flop_counts()["Global"]
    own = sum(count for kind, count in counts.items() if "conv" in str(kind))
    peak = {
        kind: _product(dtype) for kind, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    }
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        full["ours"].step(batch)
        seconds.append(time.perf_counter() - began)
    rate = work / min(seconds)
    best = max(peak["float32"], _rate_of_convolution())
    return [
        row("step: arithmetic", work / 1e9, "GFLOP"),
        row("step: share of the convolutions in the arithmetic", own / work, ""),
        row("step: share of the convolutions in the time", convolution_share(full["ours"], batch), ""),
        row("machine: matrix product 2048, float32", peak["float32"] / 1e9, "GFLOP/s"),
        row("machine: matrix product 2048, bfloat16", peak["bfloat16"] / 1e9, "GFLOP/s"),
        row("machine: best of product and 3x3 convolution, float32", best / 1e9, "GFLOP/s"),
        row("step, ours: rate", rate / 1e9, "GFLOP/s"),
        row("step, ours: share of the machine's limit", rate / best, ""),
    ]


def convolution_share(chosen: Contestant, batch: Batch) -> float:
    """Return the part of a step's time that is spent in convolutions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with profile(activities=[ProfilerActivity.CPU], acc_events=True) as recorded:
            chosen.step(batch)
    events = recorded.key_averages()
    total = sum(event.self_cpu_time_total for event in events)
    own = sum(e.self_cpu_time_total for e in events if any(part in e.key for part in CONVOLUTIONS))
    return own / total


def _image(channels: int, kernel: int, dtype: torch.dtype = torch.float32) -> Tensor:
    side = SIZE + kernel - 1
    return torch.randn(1, channels, side, side).to(dtype).contiguous(memory_format=torch.channels_last)


def _weight(inputs: int, outputs: int, kernel: int) -> Tensor:
    weight = torch.randn(outputs, inputs, kernel, kernel) / (inputs * kernel**2) ** 0.5
    return weight.contiguous(memory_format=torch.channels_last)


def _trained(forward: Callable[..., Tensor], *tensors: Tensor) -> Call:
    """Return a call of a function with the gradients of all its arguments."""
    arguments = [tensor.detach().requires_grad_() for tensor in tensors]
    with torch.no_grad():
        gradient = torch.randn_like(forward(*arguments))
    return lambda: torch.autograd.grad(forward(*arguments), arguments, gradient)


def _convolution(
    inputs: int, outputs: int, kernel: int, memory_format: torch.memory_format, dtype: torch.dtype
) -> Call:
    image = _image(inputs, kernel, dtype).contiguous(memory_format=memory_format)
    weight = _weight(inputs, outputs, kernel).to(dtype).contiguous(memory_format=memory_format)
    return _trained(F.conv2d, image, weight)


def _two(merged: bool) -> Call:
    image, one, other = _image(CHANNELS, 1), _weight(CHANNELS, CHANNELS, 1), _weight(CHANNELS, CHANNELS, 1)
    if merged:
        return _trained(lambda x, a, b: F.conv2d(x, torch.cat([a, b])), image, one, other)
    return _trained(lambda x, a, b: torch.cat([F.conv2d(x, a), F.conv2d(x, b)], 1), image, one, other)


def _fusion(split: bool) -> Call:
    image, aux, weight = _image(CHANNELS, 1), _image(CHANNELS, 1), _weight(2 * CHANNELS, CHANNELS, 1)

    def parts(x: Tensor, a: Tensor, w: Tensor) -> Tensor:
        return F.conv2d(x, w[:, :CHANNELS]).add_(F.conv2d(a, w[:, CHANNELS:]))

    return _trained(parts if split else lambda x, a, w: F.conv2d(torch.cat([x, a], 1), w), image, aux, weight)


def _extractor(merged: bool) -> Call:
    kernels = [_weight(7, CHANNELS, size) for size in (1, 3, 5)]
    image = _image(7, 5)

    def three(x: Tensor, *weights: Tensor) -> Tensor:
        return torch.cat([F.conv2d(_cut(x, w), w) for w in weights], 1)

    def one(x: Tensor, *weights: Tensor) -> Tensor:
        return F.conv2d(x, torch.cat([F.pad(w, [(5 - w.shape[-1]) // 2] * 4) for w in weights]))

    return _trained(one if merged else three, image, *kernels)


def _cut(image: Tensor, weight: Tensor) -> Tensor:
    edge = (5 - weight.shape[-1]) // 2
    return image[..., edge : image.shape[-2] - edge, edge : image.shape[-1] - edge]


def _high(tensor: Tensor) -> Tensor:
    return tensor.bfloat16().to(tensor.dtype)


def _three_products(image: Tensor, pieces: Tensor) -> Tensor:
    """Return the convolution from bfloat16 products that oneDNN adds up in float32."""
    high = _high(image)
    before = _ONEDNN.conv.fp32_precision
    _ONEDNN.conv.fp32_precision = "bf16"
    try:
        return F.conv2d(torch.cat([high, image - high, high], 1), pieces)
    finally:
        _ONEDNN.conv.fp32_precision = before


def _product(dtype: torch.dtype) -> float:
    a, b = torch.randn(2048, 2048).to(dtype), torch.randn(2048, 2048).to(dtype)
    return 2 * 2048**3 / _least(lambda: a @ b)


def _rate_of_convolution() -> float:
    image, weight = _image(CHANNELS, 3), _weight(CHANNELS, CHANNELS, 3)
    with torch.no_grad():
        return 2 * CHANNELS**2 * 9 * SIZE**2 / _least(lambda: F.conv2d(image, weight))


def _least(call: Call, repeats: Sequence[int] = range(9)) -> float:
    times = []
    for _ in repeats:
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
