"""Attention of every pixel to a window around it, without an unfolded image and without stored attention.

    output(p) = sum_t softmax_t( q(p) . (k(t) + e(t)) / sqrt(d) ) v(t)

per head of d channels. In `block_attention` the pixels of a block share one window, the block and a band of
`halo` pixels around it, and e depends on the position in that window (Yu et al. 2021,
doi:10.1145/3478513.3480565, equations 4 and 6 to 7, and section 3.3.2). In `local_attention` every pixel has
the window centred on it, and e depends on the offset from it. e(row, column) is row table | column table.

Pixels outside the image have k = 0 and v = 0. As in the authors' code they take part in the softmax, by
their position alone; `mask_halo` leaves them out.

Rows of blocks are processed one after another: their windows are copied, multiplied and dropped. Training
keeps q, k and v, and computes the windows again in the backward pass. On a CPU a row of blocks stays in the
cache, which is also why this is faster than one large unfolded image.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from models.ops.boxes import exporting
from models.ops.precision import wide
from models.ops.windows import Chunk, Windows, WindowSum, chunks, local_offsets


def block_attention(
    q: Tensor, k: Tensor, v: Tensor, tables: tuple[Tensor, Tensor], windows: Windows
) -> Tensor:
    """Attend from the pixels of every block to the block and its halo; see the module's equation.

    Exact: equal to unfold, softmax and weighted sum to rounding, gradients included. Computed in float32
    (float64 for float64 input), also under mixed precision. Differentiable once. Graphs recorded for export
    hold the unfolded form.

    Args:
        q: Queries (B, C, H, W); with channels innermost in memory nothing is copied beforehand.
        k: Keys of the same shape.
        v: Values of the same shape.
        tables: Row and column positions, each (windows.own[1], C / heads / 2), added to the first and the
            second half of each head's keys.
        windows: Which pixels are attended to.

    Returns:
        (B, C, H, W).

    Raises:
        ValueError: Shapes do not fit together.
    """
    if not exporting():
        _check(q, k, v, tables, windows)
    q, k, v = wide(q), wide(k), wide(v)
    position = position_table(*tables).to(q.dtype)
    with torch.autocast(q.device.type, enabled=False):
        if exporting():
            return _unfolded(q, k, v, position, windows)
        images = _Images(*(t.permute(0, 2, 3, 1) for t in (q, k, v)))
        if torch.is_grad_enabled() and any(t.requires_grad for t in (*images, position)):
            result: Tensor = _Attention.apply(*images, position, windows)
        else:
            result = _forward(images, position, windows)
    return result.permute(0, 3, 1, 2)


def position_table(rows: Tensor, columns: Tensor) -> Tensor:
    """Return the positions (side², d) of a window's pixels from the tables (side, d / 2) of both axes."""
    side, half = rows.shape
    both = [rows[:, None].expand(side, side, half), columns[None].expand(side, side, half)]
    return torch.cat(both, -1).reshape(side * side, 2 * half)


def _check(q: Tensor, k: Tensor, v: Tensor, tables: tuple[Tensor, Tensor], windows: Windows) -> None:
    if not q.shape == k.shape == v.shape:
        raise ValueError(f"q, k and v differ in shape: {tuple(q.shape)}, {tuple(k.shape)}, {tuple(v.shape)}")
    if q.shape[1] % (2 * windows.heads):
        raise ValueError(f"{q.shape[1]} channels cannot be split into {windows.heads} heads of even width")
    if any(size % windows.own[0] for size in q.shape[2:]):
        raise ValueError(f"an image of {q.shape[3]}x{q.shape[2]} is not made of blocks of {windows.own[0]}")
    expected = (windows.own[1], q.shape[1] // windows.heads // 2)
    for name, table in zip(("row", "column"), tables, strict=True):
        if tuple(table.shape) != expected:
            raise ValueError(f"the {name} table has shape {tuple(table.shape)}, expected {expected}")


def attention_weights(
    q: Tensor, k: Tensor, tables: tuple[Tensor, Tensor], windows: Windows, pixel: tuple[int, int]
) -> Tensor:
    """Return the attention of one pixel as an image per head.

    Args:
        q: Queries (B, C, H, W).
        k: Keys of the same shape.
        tables: See `block_attention`.
        windows: See `block_attention`.
        pixel: Row and column of the query.

    Returns:
        (B, heads, H, W), 0 outside the window. What pixels outside the image take is missing in the sum,
        which is 1 where they are masked or the window lies inside the image.
    """
    row, column = pixel
    batch, _, height, width = q.shape
    heads, halo = windows.heads, windows.halo
    block, side = windows.own
    top, left = row // block * block, column // block * block
    size = (-(-height // block) * block, -(-width // block) * block)
    padding = [halo, size[1] - width + halo, halo, size[0] - height + halo]
    rows, columns = slice(top, top + side), slice(left, left + side)
    keys = F.pad(wide(k), padding)[..., rows, columns].reshape(batch, heads, -1, side * side)
    keys = keys + position_table(*tables).to(keys.dtype).t()
    query = wide(q)[..., row, column].reshape(batch, heads, 1, -1)
    scores = (query @ keys) * query.shape[-1] ** -0.5
    inside = F.pad(scores.new_ones(height, width), padding)[rows, columns].flatten() > 0
    if windows.mask_halo:
        scores = scores.masked_fill(~inside, -torch.inf)
    found = scores.new_zeros(batch, heads, size[0] + 2 * halo, size[1] + 2 * halo)
    found[..., rows, columns] = scores.softmax(-1).reshape(batch, heads, side, side)
    return found[..., halo : halo + height, halo : halo + width]


def _unfolded(q: Tensor, k: Tensor, v: Tensor, position: Tensor, windows: Windows) -> Tensor:
    """Write the attention out with every window unfolded: the form that other runtimes understand."""
    batch, channels, height, width = q.shape
    heads = windows.heads
    block, side = windows.own
    head = channels // heads

    def unfold(maps: Tensor, size: int, padding: int) -> Tensor:
        columns = F.unfold(maps, size, padding=padding, stride=block)
        return columns.reshape(batch, -1, head, size * size, columns.shape[-1]).permute(0, 1, 4, 3, 2)

    queries = unfold(q, block, 0) * head**-0.5
    keys, values = unfold(k, side, windows.halo) + position, unfold(v, side, windows.halo)
    scores = queries @ keys.transpose(-1, -2)
    if windows.mask_halo:
        inside = unfold(torch.ones_like(q[:, :head]), side, windows.halo)[..., 0]
        scores = scores.masked_fill(inside[..., None, :] == 0, -torch.inf)
    attended = (torch.softmax(scores, -1) @ values).reshape(
        batch, heads, height // block, width // block, block, block, head
    )
    return attended.permute(0, 1, 6, 2, 4, 3, 5).reshape(batch, channels, height, width)


class _Images(NamedTuple):
    """Queries, keys and values with channels last, (B, H, W, C)."""

    q: Tensor
    k: Tensor
    v: Tensor


class _Cut(NamedTuple):
    """A chunk's part of `_Images`: N = blocks times heads.

    Attributes:
        q: (N, block², d), scaled.
        k: (N, side², d), with positions unless windows are local.
        v: (N, side², d).
        weights: The softmax, (N, block², side²), or (N, block², own²) where windows are local.
    """

    q: Tensor
    k: Tensor
    v: Tensor
    weights: Tensor


def _cut(images: _Images, position: Tensor, chunk: Chunk) -> _Cut:
    windows = chunk.windows
    q = chunk.queries(images.q).mul_(position.shape[-1] ** -0.5)
    k = chunk.keys(images.k, None if windows.local else position)
    v = chunk.keys(images.v)
    scores = q @ k.transpose(1, 2)
    if windows.local:
        scores = scores.gather(2, _places(windows, scores)).add_(q @ position.t())
    if windows.mask_halo:
        # Queries beyond the image have no pixel at all: the least number keeps their softmax finite.
        shape = (-1, windows.heads, *scores.shape[1:])
        outside = chunk.outside(images.q.device)[:, None]
        scores = scores.view(shape).masked_fill_(outside, torch.finfo(scores.dtype).min).view_as(scores)
    return _Cut(q, k, v, torch.softmax(scores, 2))


def _spread(weights: Tensor, chunk: Chunk) -> Tensor:
    """Return weights of local windows as weights of the block's window, (N, block², side²)."""
    if not chunk.windows.local:
        return weights
    spread = weights.new_zeros(*weights.shape[:2], chunk.windows.side**2)
    return spread.scatter_(2, _places(chunk.windows, weights), weights)


def _places(windows: Windows, like: Tensor) -> Tensor:
    """Return where the keys of every query lie in its block's window, (N, block², own²)."""
    return local_offsets(windows, like.device).expand(len(like), -1, -1)


def _forward(images: _Images, position: Tensor, windows: Windows) -> Tensor:
    result = torch.empty_like(images.v, memory_format=torch.contiguous_format)
    for chunk in chunks(result, windows):
        cut = _cut(images, position, chunk)
        chunk.store(result, _spread(cut.weights, chunk) @ cut.v)
    return result


class _Attention(torch.autograd.Function):
    """`_forward` with a backward pass that keeps only q, k, v and computes the weights P again.

    With S the scores, dP = dO V', dS = P (dP - row sums of P dP): dQ = dS K, dK = dS' Q, dV = P' dO, and the
    positions receive what the keys at them receive.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, k: Tensor, v: Tensor, position: Tensor, windows: Windows) -> Tensor:
        ctx.save_for_backward(q, k, v, position)
        ctx.windows = windows
        return _forward(_Images(q, k, v), position, windows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, position = ctx.saved_tensors
        images, windows = _Images(*tensors), ctx.windows
        d_q, d_position = torch.empty_like(images.q), torch.zeros_like(position)
        d_k, d_v = WindowSum(images.k, windows), WindowSum(images.v, windows)
        for chunk in chunks(images.q, windows):
            cut, d_out = _cut(images, position, chunk), chunk.queries(gradient)
            d_v.add(_spread(cut.weights, chunk).transpose(1, 2) @ d_out, chunk)
            d_weights = d_out @ cut.v.transpose(1, 2)
            if windows.local:
                d_weights = d_weights.gather(2, _places(windows, d_weights))
            d_scores = torch._softmax_backward_data(d_weights, cut.weights, 2, d_weights.dtype)
            d_full = _spread(d_scores, chunk)
            d_keys = d_full.transpose(1, 2) @ cut.q
            d_queries = d_full @ cut.k
            if windows.local:
                d_queries += d_scores @ position
                d_position += d_scores.flatten(0, 1).t() @ cut.q.flatten(0, 1)
            else:
                d_position += d_keys.sum(0)
            d_k.add(d_keys, chunk)
            chunk.store(d_q, d_queries.mul_(position.shape[-1] ** -0.5))
        return d_q, d_k.image, d_v.image, d_position, None
