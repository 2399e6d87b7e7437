"""MR-KP written down step by step from its description, both presets: the reference of its tests.

Nothing of the product's code is used: loops over pixels and taps for kernels and upsampling. The U-Net, means
of 2x2 pixels and the loop of a softmax kernel are those that other networks are compared with.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from tests.models.plain_kp import plain_gather_inside
from tests.models.plain_wskp_mr import mean_of_four, plain_heads


def plain_gather_positive(image: Tensor, weights: Tensor, size: int) -> Tensor:
    """Visit every pixel, channel and tap; taps outside or not above 0 in a channel do not count."""
    batch, channels, height, width = image.shape
    reach = size // 2
    pixels = []
    for b, c, y, x in product(range(batch), range(channels), range(height), range(width)):
        total = divisor = image.new_zeros(())
        for dy, dx in product(range(-reach, reach + 1), range(-reach, reach + 1)):
            if not (0 <= y + dy < height and 0 <= x + dx < width):
                continue
            value, weight = image[b, c, y + dy, x + dx], weights[b, (dx + reach) + size * (dy + reach), y, x]
            if value > 0:
                total, divisor = total + weight * value, divisor + weight
        pixels.append(total / (divisor + 1e-8))
    return torch.stack(pixels).reshape(image.shape)


def unfold_positive(image: Tensor, weights: Tensor, size: int) -> Tensor:
    """The same as one writes it with PyTorch: unfold the image, leave out taps, multiply, sum."""
    batch, channels, height, width = image.shape
    patches = F.unfold(image, size, padding=size // 2).reshape(batch, channels, size * size, height, width)
    counted = weights[:, None] * (patches > 0)
    return (counted * patches).sum(2) / (counted.sum(2) + 1e-8)


def plain_doubled(image: Tensor) -> Tensor:
    """Even coordinates copy, odd ones are the mean of the 2 or 4 nearest pixels that there are."""
    height, width = image.shape[-2:]

    def nearest(position: int, count: int) -> list[int]:
        around = [position // 2] if position % 2 == 0 else [(position - 1) // 2, (position + 1) // 2]
        return [index for index in around if index < count]

    rows = []
    for y in range(2 * height):
        row = []
        for x in range(2 * width):
            sources = list(product(nearest(y, height), nearest(x, width)))
            row.append(sum(image[..., i, j] for i, j in sources) / len(sources))
        rows.append(torch.stack([torch.as_tensor(pixel) for pixel in row], -1))
    return torch.stack(rows, -2)


def plain_repeated(image: Tensor) -> Tensor:
    """Every pixel four times."""
    height, width = image.shape[-2:]
    rows = [
        torch.stack([image[..., y // 2, x // 2] for x in range(2 * width)], -1) for y in range(2 * height)
    ]
    return torch.stack(rows, -2)


def plain_inputs(buffers: Mapping[str, Tensor], preset: str) -> Tensor:
    """Return the ten channels of a frame whose exposure is 1."""
    light, albedo = buffers["irradiance"], buffers["albedo"]
    color = light if preset == "meng" else ((light * albedo).clamp(min=0) ** 0.454545).clamp(max=1)
    frames = [(depth - depth.min()) / (depth.max() - depth.min()) for depth in buffers["depth"]]
    return torch.cat([color, albedo, buffers["normal"] * 0.5 + 0.5, torch.stack(frames)], 1)


def plain_mrkp(
    state: Mapping[str, Tensor],
    buffers: Mapping[str, Tensor],
    preset: str,
    levels: int = 5,
    count: int = 3,
    size: int = 5,
) -> Tensor:
    """The whole network, `wskp` or `meng`, for an exposure of 1 and sides that are multiples of 2**levels."""
    heads = plain_heads(state, plain_inputs(buffers, preset), levels, count)
    images = [buffers["irradiance"]]
    for _ in range(count):
        images.append(mean_of_four(images[-1]))
    result = images[count]  # meng: the fourth level
    for level in reversed(range(count)):
        kernels, last = heads[level][:, : size * size], heads[level][:, size * size :]
        if preset == "meng":
            fine = plain_gather_positive(images[level], kernels.clamp(min=0), size)
            alpha, upsampled = last.clamp(min=0), plain_doubled
        else:
            fine = plain_gather_inside(images[level], kernels, size)
            alpha, upsampled = 1 / (1 + (-last).exp()), plain_repeated
            if level == count - 1:
                result = fine
                continue
        result = fine - alpha * upsampled(mean_of_four(fine)) + alpha * upsampled(result)
    return result * buffers["albedo"]
