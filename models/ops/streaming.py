"""What happens at every pixel on its own, done for some rows at a time.

Networks of 1x1 convolutions on every sample need many numbers per pixel for a short time. Here these exist
for a strip of rows, so memory beside inputs and results grows neither with the image nor with the number of
samples; in training a strip is computed again in the backward pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from models.ops.boxes import exporting

_CHUNK = 1 << 22
"""Numbers of the widest intermediate result that exist at once on a CPU: 16 MB."""

_CHUNK_DEVICE = 1 << 26
"""The same on other devices, where calls cost more."""


def streamed(
    function: Callable[..., Tensor], tensors: Sequence[Tensor], numbers: int, recompute: bool
) -> Tensor:
    """Return `function(*tensors)`, computed strip by strip.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h, W), every pixel on its own.
        tensors: (…, H, W).
        numbers: Numbers per pixel of its widest intermediate result, batch included.
        recompute: Keep none of them for the backward pass, but compute them again.
    """
    if exporting():
        return function(*tensors)
    made = [_run(function, strip, recompute) for strip in _strips(tensors, numbers)]
    return made[0] if len(made) == 1 else torch.cat(made, -2)


def scattered(
    function: Callable[..., Tensor], tensors: Sequence[Tensor], radius: int, numbers: int, recompute: bool
) -> Tensor:
    """Return the sum of what a function spreads from every pixel to its neighbours, computed strip by strip.

    Args:
        function: Maps tensors (…, h, W) to one of (…, h + 2 radius, W), a sum over pixels that also reaches
            `radius` rows above and below.
        tensors: (…, H, W).
        radius: Rows that the function reaches.
        numbers: Numbers per pixel of its widest intermediate result, batch included.
        recompute: Keep none of them for the backward pass, but compute them again.

    Returns:
        (…, H, W): rows beyond the image are dropped.
    """
    if exporting():
        return function(*tensors)[..., radius:-radius, :]
    height, first, total = tensors[0].shape[-2], 0, torch.empty(0)
    for strip in _strips(tensors, numbers):
        made = _run(function, strip, recompute)
        if first == 0:
            total = made.new_zeros(*made.shape[:-2], height + 2 * radius, made.shape[-1])
        total[..., first : first + made.shape[-2], :] += made
        first += made.shape[-2] - 2 * radius
    return total[..., radius : radius + height, :]


def _strips(tensors: Sequence[Tensor], numbers: int) -> Iterator[tuple[Tensor, ...]]:
    """Return the tensors cut into rows; cut in one go, so that gradients are joined in one go."""
    limit = _CHUNK if tensors[0].device.type == "cpu" else _CHUNK_DEVICE
    rows = max(1, limit // max(numbers * tensors[0].shape[-1], 1))
    return zip(*(tensor.split(rows, -2) for tensor in tensors), strict=True)


def _run(function: Callable[..., Tensor], tensors: Sequence[Tensor], recompute: bool) -> Tensor:
    if not (recompute and torch.is_grad_enabled()):
        return function(*tensors)
    made: Tensor = checkpoint(function, *tensors, use_reentrant=False, preserve_rng_state=False)
    return made
