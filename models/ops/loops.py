"""Strips of rows in recorded graphs.

`torch.jit.trace` follows Python loops and so fixes the number of their steps. Here the work on one strip is
recorded on its own and called by a scripted loop, which TorchScript and ONNX (`Loop`) both have: what a graph
holds for a short time grows neither with the image nor with the number of samples.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

CHUNK = 1 << 22
"""Numbers of the widest intermediate result that exist at once: 16 MB."""

Join = Callable[[Tensor, Tensor], Tensor]


def looped(
    function: Callable[..., Tensor], tensors: Sequence[Tensor], shared: Sequence[Tensor], numbers: int
) -> Tensor:
    """Return `function(*tensors, *shared)`, computed strip by strip, for a graph that is being recorded.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h, W), every pixel on its own. It must not use other
            tensors that were computed from the inputs: they would become constants of the graph.
        tensors: (…, H, W), cut into strips.
        shared: Handed over as they are.
        numbers: Numbers per pixel of its widest intermediate result, batch included.
    """

    return _run(function, (tensors, shared), numbers, 0, torch.add)


def overlapped(
    function: Callable[..., Tensor],
    tensors: Sequence[Tensor],
    shared: Sequence[Tensor],
    numbers: int,
    reach: int,
    join: Join = torch.add,
) -> Tensor:
    """Return what a function brings to pixels and to those around, strip by strip, for a recorded graph.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h + 2 reach, W); see `looped`.
        tensors: (…, H, W).
        shared: Handed over as they are.
        numbers: As for `looped`.
        reach: Rows above and below a strip that the function brings something to, at least 1.
        join: What two strips make of pixels that both bring something to, (…, n, W) each.

    Returns:
        (…, H + 2 reach, W).
    """

    return _run(function, (tensors, shared), numbers, 2 * reach, join)


def _run(
    function: Callable[..., Tensor],
    tensors: tuple[Sequence[Tensor], Sequence[Tensor]],
    numbers: int,
    overlap: int,
    join: Join,
) -> Tensor:
    every = (*tensors[0], *tensors[1])

    def record() -> Any:
        step = _recorded(function, *tensors)
        made = function(*every)[..., :1, :]
        both = torch.jit.trace(join, (made, made + 1), check_trace=False)
        kind = _tuple_of(every)
        if not torch.onnx.is_in_onnx_export():
            return _in_place(step, both, kind)
        return _overlapping_parts(step, both, kind) if overlap else _parts(step, kind)

    return _outside(record)(every, _counted(numbers), CHUNK, overlap)


def _in_place(step: Any, both: Any, Every: Any) -> Any:
    """Return the loop that writes into the result. Parts that stay would break up the memory of those that
    go, with which TorchScript's allocator ends up taking several times as much."""

    def loop(every: Every, numbers: Tensor, chunk: int, overlap: int) -> Tensor:
        image = torch.jit.annotate(Every, every)[0]
        height, rows = image.size(-2), max(1, chunk // max(int(numbers) * image.size(-1), 1))
        out = torch.empty(0)
        for first in range(0, height, rows):
            made = step(every, 0 * numbers + first, 0 * numbers + min(first + rows, height))
            if first == 0:
                sizes = made.size()
                sizes[-2] = height + overlap
                out = made.new_empty(sizes)
            elif overlap > 0:
                before = out[..., first : first + overlap, :]
                made[..., :overlap, :] = both(made[..., :overlap, :], before)
            out[..., first : first + made.size(-2), :] = made
        return out

    return torch.jit.script(loop)


def _parts(step: Any, Every: Any) -> Any:
    """Return the loop for ONNX, which has no tensors that are written into; nothing overlaps."""

    def loop(every: Every, numbers: Tensor, chunk: int, overlap: int) -> Tensor:
        image = torch.jit.annotate(Every, every)[0]
        height, rows = image.size(-2), max(1, chunk // max(int(numbers) * image.size(-1), 1))
        parts: list[Tensor] = []
        for first in range(0, height, rows):
            parts.append(step(every, 0 * numbers + first, 0 * numbers + min(first + rows, height)))
        return torch.cat(parts, -2)

    return torch.jit.script(loop)


def _overlapping_parts(step: Any, both: Any, Every: Any) -> Any:
    """Return the loop for ONNX where strips overlap: the last rows of one wait for the next."""

    def loop(every: Every, numbers: Tensor, chunk: int, overlap: int) -> Tensor:
        image = torch.jit.annotate(Every, every)[0]
        height, rows = image.size(-2), max(1, chunk // max(int(numbers) * image.size(-1), 1))
        made = step(every, 0 * numbers, 0 * numbers + min(rows, height))
        parts = [made[..., :-overlap, :]]
        last = made[..., -overlap:, :]
        for first in range(rows, height, rows):
            made = step(every, 0 * numbers + first, 0 * numbers + min(first + rows, height))
            made = torch.cat([both(made[..., :overlap, :], last), made[..., overlap:, :]], -2)
            parts.append(made[..., :-overlap, :])
            last = made[..., -overlap:, :]
        parts.append(last)
        return torch.cat(parts, -2)

    return torch.jit.script(loop)


def _tuple_of(tensors: Sequence[Tensor]) -> Any:
    """Return the type of a tuple of so many tensors. ONNX would copy the members of a list for each strip.

    A scripted function finds a type that it names in its body.
    """
    return tuple[(Tensor,) * len(tensors)]  # type: ignore[misc]


def _recorded(function: Callable[..., Tensor], tensors: Sequence[Tensor], shared: Sequence[Tensor]) -> Any:
    """Return a graph that cuts rows from `first` to `last` and calls the function."""
    every = tuple(tensor.detach() for tensor in (*tensors, *shared))
    cut = len(tensors)

    def strip(every: tuple[Tensor, ...], first: Tensor, last: Tensor) -> Tensor:
        return function(*(image[..., first:last, :] for image in every[:cut]), *every[cut:])

    rows = torch.zeros((), dtype=torch.int64), torch.ones((), dtype=torch.int64) * tensors[0].shape[-2]
    step = torch.jit.trace(strip, (every, *rows), check_trace=False)
    # The sizes of this example would count as constants where the loop is inlined; ONNX needs the ranks.
    for node in step.graph.nodes():
        for value in node.outputs():
            if value.isCompleteTensor():
                value.setType(value.type().with_sizes([None] * value.type().dim()))
    return step


def _counted(numbers: int | Tensor) -> Tensor:
    """Return a number as a tensor; one made of sizes must not become a constant of the graph."""
    return torch.ones((), dtype=torch.int64) * numbers


def _outside(record: Callable[[], Any]) -> Any:
    """Return what is recorded in a thread of its own: one graph cannot be recorded within another's."""

    def without_gradients() -> Any:
        with torch.no_grad():
            return record()

    with warnings.catch_warnings(), ThreadPoolExecutor(1) as threads:
        warnings.filterwarnings("ignore", "`torch.jit", DeprecationWarning)
        return threads.submit(without_gradients).result()
