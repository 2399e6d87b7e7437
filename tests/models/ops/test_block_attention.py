"""Attention computed chunk by chunk is what the equation says, with its gradients."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.ops import windows as cutting
from models.ops.block_attention import attention_weights, block_attention
from models.ops.windows import Windows
from tests.models.frames import largest_relative

SHAPES = [
    Windows(2, 4, 1),
    Windows(1, 4, 0),
    Windows(2, 2, 3),
    Windows(1, 4, 3, mask_halo=True),
    Windows(2, halo=1, local=True),
    Windows(1, halo=3, local=True, mask_halo=True),
]


def tensors(windows: Windows, height: int = 8, width: int = 12, batch: int = 2) -> list[Tensor]:
    """Return q, k, v and the tables of rows and columns."""
    torch.manual_seed(3)
    head = 4
    images = [torch.randn(batch, windows.heads * head, height, width, dtype=torch.float64) for _ in range(3)]
    tables = [torch.randn(windows.own[1], head // 2, dtype=torch.float64) for _ in range(2)]
    return [t.requires_grad_() for t in (*images, *tables)]


def attend(parts: list[Tensor], windows: Windows) -> Tensor:
    q, k, v, rows, columns = parts
    return block_attention(q, k, v, (rows, columns), windows)


def window_of(row: int, column: int, windows: Windows) -> tuple[int, int]:
    """Return where the window of a query begins."""
    if windows.local:
        return row - windows.halo, column - windows.halo
    block, halo = windows.block, windows.halo
    return row // block * block - halo, column // block * block - halo


def by_loops(parts: list[Tensor], windows: Windows) -> Tensor:
    """The equation, one query, head and key at a time."""
    q, k, v, rows, columns = (t.detach() for t in parts)
    batch, channels, height, width = q.shape
    head = channels // windows.heads
    result = torch.zeros_like(q)
    for b, h, y, x in itertools.product(range(batch), range(windows.heads), range(height), range(width)):
        own = slice(h * head, (h + 1) * head)
        top, left = window_of(y, x, windows)
        scores, values = [], []
        for i, j in itertools.product(range(windows.own[1]), repeat=2):
            inside = 0 <= top + i < height and 0 <= left + j < width
            if windows.mask_halo and not inside:
                continue
            key = torch.cat([rows[i], columns[j]])
            key = key + (k[b, own, top + i, left + j] if inside else 0)
            scores.append(q[b, own, y, x] @ key / head**0.5)
            values.append(v[b, own, top + i, left + j] if inside else torch.zeros_like(key))
        weights = torch.stack(scores).softmax(0)
        result[b, own, y, x] = (weights[:, None] * torch.stack(values)).sum(0)
    return result


@pytest.mark.parametrize("windows", SHAPES, ids=str)
def test_the_output_is_the_equations_result(windows: Windows) -> None:
    parts = tensors(windows, 4, 8, 1)
    expected = by_loops(parts, windows)
    assert largest_relative(attend(parts, windows), expected) < 1e-13
    with torch.no_grad():
        assert largest_relative(attend(parts, windows), expected) < 1e-13


def test_one_query_checked_by_hand() -> None:
    # One pixel, no halo but a window of itself and eight pixels outside the image.
    windows = Windows(1, 1, 1)
    q, k, v = (torch.tensor([a, b]).reshape(1, 2, 1, 1) for a, b in ((2.0, 0.0), (1.0, 5.0), (3.0, 7.0)))
    rows, columns = torch.tensor([[0.0], [1.0], [0.0]]), torch.zeros(3, 1)
    # Scores are 2 (k + row) / sqrt(2): own pixel 2 * 2, its two neighbours in the row 2 * 1, the others 0.
    one = torch.exp(torch.tensor(4 / 2**0.5))
    share = one / (one + 2 * torch.exp(torch.tensor(2 / 2**0.5)) + 6)
    found = block_attention(q, k, v, (rows, columns), windows).flatten()
    torch.testing.assert_close(found, share * torch.tensor([3.0, 7.0]))
    masked = block_attention(q, k, v, (rows, columns), replace(windows, mask_halo=True)).flatten()
    torch.testing.assert_close(masked, torch.tensor([3.0, 7.0]))


@pytest.mark.parametrize("windows", SHAPES, ids=str)
def test_gradients_are_those_of_finite_differences(windows: Windows) -> None:
    parts = tensors(windows, 4, 4, 1)
    assert torch.autograd.gradcheck(lambda *p: attend(list(p), windows), parts, fast_mode=True)


@pytest.mark.parametrize("limit", [1, 1 << 14, 1 << 30])
@pytest.mark.parametrize("windows", SHAPES, ids=str)
def test_chunks_of_any_size_give_the_unfolded_result(
    windows: Windows, limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cutting._CHUNK_BYTES, "cpu", limit)
    parts = tensors(windows)
    found = attend(parts, windows)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("models.ops.block_attention.exporting", lambda: True)
        expected = attend(parts, windows)
    assert largest_relative(found, expected) < 1e-13
    weights = torch.rand_like(expected)
    for one, other in zip(
        torch.autograd.grad(found, parts, weights), torch.autograd.grad(expected, parts, weights), strict=True
    ):
        assert largest_relative(one, other) < 1e-12


@pytest.mark.parametrize("size", [(7, 11), (16, 9), (3, 20)])
def test_local_windows_need_no_multiple(size: tuple[int, int]) -> None:
    windows = Windows(1, halo=1, local=True)
    parts = tensors(windows, *size, batch=1)
    assert largest_relative(attend(parts, windows), by_loops(parts, windows)) < 1e-13


def test_pixels_outside_the_image_take_weight_unless_masked() -> None:
    windows = Windows(1, 4, 3)
    q, k, _, rows, columns = tensors(windows, batch=1)
    ones = torch.ones_like(q)
    shares = block_attention(q, k, ones, (rows, columns), windows)
    assert shares.max() < 1
    masked = block_attention(q, k, ones, (rows, columns), replace(windows, mask_halo=True))
    torch.testing.assert_close(masked, ones)


@pytest.mark.parametrize("windows", SHAPES, ids=str)
def test_weights_of_a_pixel_give_its_output(windows: Windows) -> None:
    parts = tensors(windows)
    q, k, v, rows, columns = (t.detach() for t in parts)
    expected = attend(parts, windows)
    for pixel in ((0, 0), (5, 7), (7, 11)):
        weights = attention_weights(q, k, (rows, columns), windows, pixel)
        values = v.reshape(2, windows.heads, -1, *v.shape[2:])
        found = (weights[:, :, None] * values).sum((-2, -1)).reshape(2, -1)
        assert largest_relative(found, expected[..., pixel[0], pixel[1]]) < 1e-13
        if windows.mask_halo:
            torch.testing.assert_close(weights.sum((-2, -1)), torch.ones(2, windows.heads).double())


def test_the_softmax_runs_in_float32_under_autocast() -> None:
    windows = Windows(2, 4, 1)
    parts = [t.detach().bfloat16() for t in tensors(windows)]
    with torch.autocast("cpu", torch.bfloat16):
        found = attend(parts, windows)
    assert found.dtype == torch.float32
    assert largest_relative(found, attend([t.float() for t in parts], windows)) < 1e-6


def test_an_image_that_is_not_made_of_blocks_is_refused() -> None:
    windows = Windows(2, 4, 1)
    with pytest.raises(ValueError, match=r"12x6 is not made of blocks of 4"):
        attend(tensors(windows, 6, 12), windows)


def test_tables_of_another_length_are_refused() -> None:
    parts = tensors(Windows(2, 4, 1))
    with pytest.raises(ValueError, match=r"row table has shape \(6, 2\), expected \(8, 2\)"):
        attend(parts, Windows(2, 4, 2))


def test_channels_that_do_not_split_into_heads_are_refused() -> None:
    with pytest.raises(ValueError, match="8 channels cannot be split into 3 heads"):
        attend(tensors(Windows(2, 4, 1)), Windows(3, 4, 1))


def test_images_of_different_shape_are_refused() -> None:
    q, k, v, rows, columns = tensors(Windows(2, 4, 1))
    with pytest.raises(ValueError, match="q, k and v differ in shape"):
        block_attention(q, k[:1], v, (rows, columns), Windows(2, 4, 1))
