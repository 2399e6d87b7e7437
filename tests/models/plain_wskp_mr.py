"""Multi-resolution WSKP written down step by step from its description: the reference of its tests.

Nothing of the product's code is used: loops over pixels for filters, means and equation 7, and transposed
convolutions as convolutions of images with zeros between the pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor


def plain_filmic(radiance: Tensor) -> Tensor:
    """The film curve, as printed."""
    t = (radiance - 0.004).clamp(min=0)
    return (t * (6.2 * t + 0.5)) / (t * (6.2 * t + 1.7) + 0.06)


def mean_of_four(image: Tensor) -> Tensor:
    """Means of 2x2 pixels."""
    height, width = image.shape[-2] // 2, image.shape[-1] // 2
    result = image.new_zeros(*image.shape[:-2], height, width)
    for y, x in product(range(height), range(width)):
        result[..., y, x] = image[..., 2 * y : 2 * y + 2, 2 * x : 2 * x + 2].sum((-2, -1)) / 4
    return result


def spread_out(maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve transposed: pixel (i, j) adds weight (a, b) of 3x3 to pixel (2 i + a - 1, 2 j + b - 1)."""
    batch, channels, height, width = maps.shape
    between = maps.new_zeros(batch, channels, 2 * height, 2 * width)
    between[..., ::2, ::2] = maps
    return F.conv2d(between, weight.transpose(0, 1).flip(2, 3), bias, padding=1)


def plain_heads(state: Mapping[str, Tensor], features: Tensor, levels: int, heads: int) -> list[Tensor]:
    """Return the outputs of the U-Net, from fine to coarse, from a state dict."""

    def of(name: str, number: int) -> tuple[Tensor, Tensor]:
        return state[f"unet.{name}.{number}.weight"], state[f"unet.{name}.{number}.bias"]

    maps, kept = features, []
    for level in range(levels):
        kept.append(F.conv2d(maps, *of("encoder", level), padding=1).clamp(min=0))
        maps = mean_of_four(kept[level])
    made: dict[int, Tensor] = {}
    for level in reversed(range(levels)):
        doubled = spread_out(maps, *of("decoder", levels - 1 - level)).clamp(min=0)
        maps = torch.cat([doubled, kept[level]], 1)
        if level < heads:
            made[level] = F.conv2d(maps, *of("heads", level), padding=1)
    return [made[level] for level in range(heads)]


def plain_filter(image: Tensor, importance: Tensor, fusion: Tensor, sizes: Sequence[int]) -> Tensor:
    """Filter with every kernel size (equations 3 and 4) and fuse (equation 5), pixel by pixel."""
    batch, _, height, width = image.shape
    result, shares = torch.zeros_like(image), fusion.softmax(1)
    for b, y, x in product(range(batch), range(height), range(width)):
        for number, size in enumerate(sizes):
            reach = size // 2
            window = (
                b,
                slice(max(0, y - reach), y + reach + 1),
                slice(max(0, x - reach), x + reach + 1),
            )
            powers = importance[:, number][window].exp()
            filtered = (image.movedim(1, -1)[window] * powers[..., None]).sum((0, 1)) / powers.sum()
            result[b, :, y, x] += shares[b, number, y, x] * filtered
    return result


def plain_blend(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """Equation 7, pixel by pixel."""
    result, means = torch.zeros_like(fine), mean_of_four(fine)
    for y, x in product(range(fine.shape[-2]), range(fine.shape[-1])):
        share, cell = alpha[:, :, y, x], (..., y // 2, x // 2)
        result[..., y, x] = fine[..., y, x] - share * means[cell] + share * coarse[cell]
    return result


def plain_wskp_mr(
    state: Mapping[str, Tensor],
    buffers: Mapping[str, Tensor],
    levels: int,
    count: int,
    sizes: Sequence[int],
) -> Tensor:
    """The whole network of a frame whose exposure is 1 and whose sides are multiples of 2**levels."""
    light, depth = buffers["irradiance"], buffers["depth"]
    low, high = (torch.stack([one.min() for one in sign * depth]) for sign in (1, -1))
    scaled = (depth - low[:, None, None, None]) / (-high - low)[:, None, None, None]
    color = plain_filmic(light * buffers["albedo"])
    features = torch.cat([color, buffers["albedo"], (buffers["normal"] + 1) / 2, scaled], 1)
    heads = plain_heads(state, features, levels, count)
    images = [light]
    for _ in range(count - 1):
        images.append(mean_of_four(images[-1]))
    kernels, result = len(sizes), torch.empty(0)
    for level in reversed(range(count)):
        maps = heads[level]
        filtered = plain_filter(images[level], maps[:, :kernels], maps[:, kernels : 2 * kernels], sizes)
        coarsest = level == count - 1
        alpha = 1 / (1 + (-maps[:, 2 * kernels :]).exp())
        result = filtered if coarsest else plain_blend(filtered, result, alpha)
    return result * buffers["albedo"]
