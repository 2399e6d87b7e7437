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

    every = (*tensors, *shared)
    Every = _tuple_of(every)

    def record() -> Any:
        step = _recorded(function, tensors, shared)

        def loop(every: Every, numbers: Tensor, chunk: int) -> Tensor:  # type: ignore[valid-type]
            first_image = torch.jit.annotate(Every, every)[0]
            height, width = first_image.size(-2), first_image.size(-1)
            rows = max(1, chunk // max(int(numbers) * width, 1))
            parts: list[Tensor] = []
            for first in range(0, height, rows):
                parts.append(step(every, 0 * numbers + first, 0 * numbers + min(first + rows, height)))
            return torch.cat(parts, -2)

        return torch.jit.script(loop)

    return _outside(record)(every, _counted(numbers), CHUNK)


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

    every = (*tensors, *shared)
    Every = _tuple_of(every)

    def record() -> Any:
        step = _recorded(function, tensors, shared)
        made = function(*every)[..., :1, :]
        both = torch.jit.trace(join, (made, made + 1), check_trace=False)

        def loop(every: Every, numbers: Tensor, chunk: int, overlap: int) -> Tensor:  # type: ignore[valid-type]
            first_image = torch.jit.annotate(Every, every)[0]
            height, width = first_image.size(-2), first_image.size(-1)
            rows = max(1, chunk // max(int(numbers) * width, 1))
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

    return _outside(record)(every, _counted(numbers), CHUNK, 2 * reach)


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
