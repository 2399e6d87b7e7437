"""What happens at every pixel on its own, done for some rows at a time.

Networks of 1x1 convolutions on every sample need many numbers per pixel for a short time. Here these exist
for a strip of rows, or for part of a row where one is too much, so memory beside inputs and results grows
neither with the image nor with the number of samples; in training a strip is computed again in the backward
pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from models.ops.boxes import exporting
from models.ops.loops import looped, overlapped

_CHUNK = 1 << 22
"""Numbers of the widest intermediate result that exist at once on a CPU: 16 MB."""

_CHUNK_DEVICE = 1 << 26
"""The same on other devices, where calls cost more."""


def streamed(
    function: Callable[..., Tensor],
    tensors: Sequence[Tensor],
    numbers: int,
    recompute: bool,
    shared: Sequence[Tensor] = (),
) -> Tensor:
    """Return `function(*tensors)`, computed strip by strip, and a row that is too much in several parts.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h, W), every pixel on its own. In a recorded graph it
            must not use other tensors that were computed from the inputs (`models.ops.loops`).
        tensors: (…, H, W).
        numbers: Numbers per pixel of its widest intermediate result, batch included.
        recompute: Keep none of them for the backward pass, but compute them again.
        shared: More arguments, such as numbers of the frame, that are not cut into strips.
    """
    if torch.jit.is_tracing():
        return looped(function, tensors, shared, numbers)
    if exporting():
        return function(*tensors, *shared)
    columns = max(1, _limit(tensors[0]) // max(numbers, 1))
    gathering = torch.is_grad_enabled()
    rows: list[Tensor] = []
    first, whole = 0, torch.empty(0)
    for strip in _strips(tensors, numbers):
        parts = zip(*(tensor.split(columns, -1) for tensor in strip), strict=True)
        fits = strip[0].shape[-1] <= columns
        cut = [(*part, *shared) for part in ([strip] if fits else parts)]
        made = _joined([_run(function, part, recompute) for part in cut], -1)
        if gathering:
            rows.append(made)
            continue
        if first == 0:  # written in place: joining strips would need twice the result
            whole = made.new_empty(*made.shape[:-2], tensors[0].shape[-2], made.shape[-1])
        whole[..., first : first + made.shape[-2], :] = made
        first += made.shape[-2]
    return _joined(rows, -2) if gathering else whole


def strip_rows(tensor: Tensor, numbers: int) -> int:
    """Return the rows of a strip of images (…, H, W) that need so many numbers per pixel; at least 1."""
    return max(1, _limit(tensor) // max(numbers * tensor.shape[-1], 1))


def scattered(
    function: Callable[..., Tensor],
    tensors: Sequence[Tensor],
    radius: int,
    numbers: int,
    recompute: bool,
    shared: Sequence[Tensor] = (),
) -> Tensor:
    """Return the sum of what a function spreads from every pixel to its neighbours, computed strip by strip.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h + 2 radius, W), a sum over pixels that also reaches
            `radius` rows above and below.
        tensors: (…, H, W).
        radius: Rows that the function reaches.
        numbers: Numbers per pixel of its widest intermediate result, batch included.
        recompute: Keep none of them for the backward pass, but compute them again.
        shared: As for `streamed`.

    Returns:
        (…, H, W): rows beyond the image are dropped.
    """
    if torch.jit.is_tracing():
        return overlapped(function, tensors, shared, numbers, radius)[..., radius:-radius, :]
    if exporting():
        return function(*tensors, *shared)[..., radius:-radius, :]
    height, first, total = tensors[0].shape[-2], 0, torch.empty(0)
    for strip in _strips(tensors, numbers):
        made = _run(function, (*strip, *shared), recompute)
        if first == 0:
            total = made.new_zeros(*made.shape[:-2], height + 2 * radius, made.shape[-1])
        total[..., first : first + made.shape[-2], :] += made
        first += made.shape[-2] - 2 * radius
    return total[..., radius : radius + height, :]


def _strips(tensors: Sequence[Tensor], numbers: int) -> Iterator[tuple[Tensor, ...]]:
    """Return the tensors cut into rows; cut in one go, so that gradients are joined in one go."""
    rows = strip_rows(tensors[0], numbers)
    return zip(*(tensor.split(rows, -2) for tensor in tensors), strict=True)


def _limit(tensor: Tensor) -> int:
    return _CHUNK if tensor.device.type == "cpu" else _CHUNK_DEVICE


def _joined(parts: list[Tensor], axis: int) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, axis)


def _run(function: Callable[..., Tensor], tensors: Sequence[Tensor], recompute: bool) -> Tensor:
    if not (recompute and torch.is_grad_enabled()):
        return function(*tensors)
    made: Tensor = checkpoint(function, *tensors, use_reentrant=False, preserve_rng_state=False)
    return made
